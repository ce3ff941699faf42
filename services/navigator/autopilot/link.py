"""MAVLink on a wire; a reading thread that answers TIMESYNC at once.

``Link`` is what the service needs of it, so that a simulated autopilot in the same process can take its place.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mav

from services.common.errors import InputError
from services.navigator.autopilot.bridge import timesync_answer
from services.navigator.autopilot.wire import WAIT_S, Wire

LOG = logging.getLogger(__name__)

_AGAIN_S = 0.5
_MAX_QUEUE = 4_000
_SIGNING_EPOCH_S = 1_420_070_400
"""1 January 2015, where MAVLink's signing time begins."""


class Link(Protocol):
    """MAVLink messages out and in."""

    def poll(self) -> list[tuple[Any, int]]:
        """Return the messages that came since the last call with their time of arrival, nanoseconds."""
        ...

    def send(self, message: Any) -> None:  # noqa: ANN401
        """Send a message, or drop it when there is nobody to send to."""
        ...

    def identify(self, system: int) -> None:
        """Speak as a component of this system from now on."""
        ...


def read_secret(path: str) -> bytes | None:
    """Return the secret in a file, None without a path.

    Raises:
        InputError: the file cannot be read or is empty.
    """
    if not path:
        return None
    try:
        secret = Path(path).read_bytes().strip()
    except OSError as error:
        raise InputError(f"autopilot.signing_key {path}: {error.strerror}") from error
    if not secret:
        raise InputError(f"autopilot.signing_key {path}: the file is empty, expected a secret")
    return secret


class Codec:
    """MAVLink 2 messages to bytes and back; TIMESYNC requests are answered here, with the clock of that very moment."""

    def __init__(self, component: int, system: int, now_ns: Callable[[], int], secret: bytes | None = None) -> None:
        self._mav = mav.MAVLink(None, srcSystem=system, srcComponent=component)
        self._mav.robust_parsing = True
        if secret is not None:
            self._sign(secret)
        self._lock = threading.Lock()
        self._now_ns = now_ns
        self.bad_bytes = 0

    def _sign(self, secret: bytes) -> None:
        """Sign what goes out and refuse what comes unsigned or wrongly signed (MAVLink 2, message signing)."""
        signing = self._mav.signing
        signing.secret_key = hashlib.sha256(secret).digest()
        signing.sign_outgoing = True
        # in 10 microseconds since 2015, on the wall's clock: it has to rise over restarts
        signing.timestamp = int((time.time() - _SIGNING_EPOCH_S) * 1e5)
        signing.link_id = self._mav.srcComponent

    def identify(self, system: int) -> None:
        """Speak as a component of this system from now on."""
        self._mav.srcSystem = system

    def pack(self, message: Any) -> bytes:  # noqa: ANN401
        """Return the frame of a message; safe from any thread."""
        with self._lock:
            data = message.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
        return bytes(data)

    def take(self, data: bytes, answer: Callable[[bytes], None]) -> list[tuple[Any, int]]:
        """Return the messages in ``data`` with their time of arrival; ``answer`` sends what cannot wait."""
        received_ns = self._now_ns()
        out = []
        for message in self._mav.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "BAD_DATA":
                self.bad_bytes += 1
            elif kind == "TIMESYNC":
                reply = timesync_answer(message, self._now_ns())
                if reply is not None:
                    answer(self.pack(reply))
                else:
                    out.append((message, received_ns))
            else:
                out.append((message, received_ns))
        return out


class MavlinkLink:
    """A wire with MAVLink 2 on it. Its thread parses what comes and answers TIMESYNC at once."""

    def __init__(self, wire: Wire, codec: Codec, reopen: Callable[[], Wire] | None = None) -> None:
        self._wire = wire
        self._reopen = reopen
        self.codec = codec
        self._queue: deque[tuple[Any, int]] = deque(maxlen=_MAX_QUEUE)
        self._stopped = threading.Event()
        self.failed = ""
        """Why the wire is dead; empty while it lives."""
        self._thread = threading.Thread(target=self._read, name="mavlink", daemon=True)
        self._thread.start()

    @property
    def bad(self) -> int:
        """What was no MAVLink, and datagrams of others than the autopilot."""
        return self.codec.bad_bytes + getattr(self._wire, "strays", 0)

    def poll(self) -> list[tuple[Any, int]]:
        """Return what came since the last call."""
        out = []
        while self._queue:
            out.append(self._queue.popleft())
        return out

    def send(self, message: Any) -> None:  # noqa: ANN401
        """Send a message; a wire that fails is told by ``failed``."""
        self._write(self.codec.pack(message))

    def identify(self, system: int) -> None:
        """Speak as a component of this system from now on."""
        self.codec.identify(system)

    def close(self) -> None:
        """Stop the thread and close the wire."""
        self._stopped.set()
        self._thread.join(2.0 * WAIT_S)
        self._wire.close()

    def _write(self, data: bytes) -> None:
        try:
            self._wire.write(data)
            self.failed = ""
        except OSError as error:
            self.failed = str(error)

    def _open_again(self) -> None:
        """Replace a dead wire: a TCP server that was restarted, a plug that was pulled. The bridge saw the gap."""
        if self._reopen is None:
            return
        try:
            fresh = self._reopen()
        except (InputError, OSError) as error:
            self.failed = str(error)
            return
        self._wire.close()
        self._wire, self.failed = fresh, ""

    def _read(self) -> None:
        while not self._stopped.is_set():
            try:
                data = self._wire.read()
            except OSError as error:  # pyserial's errors are OSErrors too
                self.failed = str(error)
                if self._stopped.wait(_AGAIN_S):
                    return
                self._open_again()
                continue
            if data:
                self._queue.extend(self.codec.take(data, self._write))
