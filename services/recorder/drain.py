"""What is to be written waits here for the disk: a thread writes, the work loop never does.

When the disk is slow, frames are dropped first and then everything; when it is full, frames stop below the reserve
and everything below a quarter of it, and recording goes on by itself in a new file once there is room.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from services.common.errors import InputError
from services.recorder.mcap_file import McapFile

if TYPE_CHECKING:
    from google.protobuf.message import Message as ProtobufMessage

LOG = logging.getLogger(__name__)

_MB = 1_000_000
_NEW_FILE_BYTES = 4 * _MB
"""Without so much room no file is begun: it would be refused at once, again and again."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One message on its way to the file."""

    key: str
    schema: str
    encoding: str
    data: bytes | ProtobufMessage
    stamp_ns: int
    seq: int
    heavy: bool
    """A camera frame: the first thing to go when disk or space run short."""

    @property
    def size(self) -> int:
        """Return about how many bytes wait."""
        return len(self.data) if isinstance(self.data, bytes) else self.data.ByteSize()


@dataclass(frozen=True, slots=True)
class Limits:
    """When to flush, to begin a new file, to drop, to stop."""

    flush_s: float
    file_bytes: int
    queue_bytes: int
    reserve_bytes: int


class Drain:
    """A bounded queue and the thread that empties it into files."""

    def __init__(self, open_file: Callable[[], McapFile], limits: Limits, free_bytes: Callable[[], int]) -> None:
        self._open_file = open_file
        self._limits = limits
        self._free_bytes = free_bytes
        self._queue: deque[Entry] = deque()
        self._queued_bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self._file: McapFile | None = None
        self.counters: Counter[str] = Counter()
        """What was written and what was dropped, for the health report."""
        self.trouble = ""
        """Why nothing, or not everything, is being recorded; empty when all is well."""
        self._file = open_file()
        self._thread = threading.Thread(target=self._run, name="recorder-drain", daemon=True)
        self._thread.start()

    def put(self, entry: Entry) -> None:
        """Queue a message, or drop and count it; never waits for the disk."""
        room = self._limits.queue_bytes * (1 if entry.heavy else 2)
        with self._changed:
            if self._queued_bytes + entry.size > room:
                self.counters["dropped_slow_disk"] += 1
                return
            self._queue.append(entry)
            self._queued_bytes += entry.size
            self._changed.notify()

    def close(self, within_s: float = 5.0) -> None:
        """Write what waits, complete the file and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(within_s)
        if self._thread.is_alive():
            LOG.warning("the disk did not take what waited within %.0f s: the file ends without an index", within_s)

    def _run(self) -> None:
        while True:
            with self._changed:
                if not self._queue and not self._closing:
                    self._changed.wait(self._limits.flush_s)
                taken, self._queue = self._queue, deque()
                self._queued_bytes = 0
                last = self._closing
            self._guarded(partial(self._write, taken))
            if last:
                self._guarded(self._complete)
                return
            with self._changed:
                if not self._closing:  # gather for a while: small chunks, but not one per message
                    self._changed.wait_for(lambda: self._closing, self._limits.flush_s)

    def _guarded(self, work: Callable[[], None]) -> None:
        """Do it; what the disk refuses costs the open file its index, and the recording goes on when it can."""
        try:
            work()
        except (OSError, InputError) as error:
            words = error.strerror if isinstance(error, OSError) else str(error)
            self._tell(f"the disk refused: {words}")
            self.counters["disk_errors"] += 1
            file, self._file = self._file, None
            if file is not None:
                try:
                    file.abandon()
                except OSError as second:
                    LOG.warning("%s: %s", file.path, second.strerror)

    def _write(self, taken: deque[Entry]) -> None:
        if not taken:
            return
        free = self._free_bytes()
        frames, anything = free >= self._limits.reserve_bytes, free >= self._limits.reserve_bytes // 4
        if not anything or (self._file is None and free < _NEW_FILE_BYTES):
            self._tell(f"the disk is full ({free // _MB} MB left): nothing is recorded until there is room")
            self.counters["dropped_disk_full"] += len(taken)
            self._complete()
            return
        if self._file is None:
            self._file = self._open_file()
        for entry in taken:
            if entry.heavy and not frames:
                self.counters["dropped_disk_full"] += 1
                continue
            self._append(self._file, entry)
        self._file.flush()
        self._tell("" if frames else f"the disk is nearly full ({free // _MB} MB left): frames are not recorded")
        if self._file.size >= self._limits.file_bytes:
            self._complete()

    def _append(self, file: McapFile, entry: Entry) -> None:
        if isinstance(entry.data, bytes):
            file.add(entry.key, entry.schema, entry.encoding, entry.data, entry.stamp_ns, entry.seq)
        else:
            file.add_foxglove(entry.key, entry.data, entry.stamp_ns)
        self.counters["written"] += 1
        self.counters["written_kb"] += entry.size // 1000

    def _complete(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _tell(self, trouble: str) -> None:
        if trouble and trouble.split("(")[0] != self.trouble.split("(")[0]:
            LOG.warning(trouble)
        self.trouble = trouble
