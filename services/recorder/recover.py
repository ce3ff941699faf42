"""Recordings that a power cut or a kill left without their end: what can be read is written anew, with an index.

The file is walked record by record. A record that is cut ends the walk; a chunk that fails its checksum is left out
and the walk goes on after it. The original is kept (``.cut``) when anything but its very end was lost.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from services.common.errors import InputError
from services.common.files import make_alike

if TYPE_CHECKING:
    from mcap.records import Channel, McapRecord
    from mcap.writer import Writer

LOG = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER_BYTES = 9 + 20 + len(MAGIC)
_LARGEST_RECORD = 256 * 1024 * 1024
_HEAD = struct.Struct("<BQ")
_END = _HEAD.pack(2, 20) + bytes(20) + MAGIC
"""A footer, where the library's reader ends."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """What became of one cut file."""

    path: Path
    messages: int
    chunks_lost: int

    def __str__(self) -> str:
        lost = (
            f", {self.chunks_lost} damaged chunk(s) left out; the original is kept as .cut" if self.chunks_lost else ""
        )
        return f"{self.path}: was cut short and is whole again, {self.messages} messages{lost}"


def is_whole(path: Path) -> bool:
    """Whether the file ends as a completed recording does.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return _ends_well(stream)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error


def _ends_well(stream: BinaryIO) -> bool:
    size = stream.seek(0, 2)
    if size < _FOOTER_BYTES + len(MAGIC):
        return False
    stream.seek(size - _FOOTER_BYTES)
    tail = stream.read(_FOOTER_BYTES)
    return tail.endswith(MAGIC) and _HEAD.unpack(tail[: _HEAD.size]) == (2, 20)


def recover_folder(folder: Path) -> list[Recovered]:
    """Mend every cut recording of a folder that nobody is writing; return what was done.

    Raises:
        InputError: a mended file cannot be written.
    """
    return [recover(path) for path in cut_recordings(folder)]


def cut_recordings(folder: Path) -> list[Path]:
    """Return the recordings of a folder that lack their end and that nobody is writing or mending.

    What this user may not read is passed over, with a warning: one foreign file is no reason not to record.
    """
    found = []
    for path in sorted(folder.glob("*.mcap")):
        try:
            with path.open("rb") as stream:
                if not (_ends_well(stream) or _is_being_written(stream)):
                    found.append(path)
        except OSError as error:
            LOG.warning("%s: cannot be looked at: %s; whose is it (ls -l)?", path, error.strerror)
    return found


def _is_being_written(stream: BinaryIO) -> bool:
    try:
        fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    fcntl.flock(stream, fcntl.LOCK_UN)
    return False


def recover(path: Path) -> Recovered:
    """Write a cut recording anew, with its index; the new file has the old one's owner and rights.

    Raises:
        InputError: it is no MCAP file at all, somebody writes or mends it now, or the new one cannot be written.
    """
    from mcap.writer import CompressionType, Writer

    from services.recorder.chunk_index import keep_small

    fresh = path.with_name(f".{path.name}.recovering")
    try:
        with _held(path) as stream, _beside(fresh, stream) as out:
            if stream.read(len(MAGIC)) != MAGIC and path.stat().st_size >= len(MAGIC):
                raise InputError(f"{path}: no MCAP file: it begins with something else")
            writer = Writer(out, chunk_size=512 * 1024, compression=CompressionType.ZSTD)
            keep_small(writer)
            writer.start(profile="treedock", library="treedock recovery")
            walk = _Walk(stream)
            copy = _Copy(writer)
            for record in walk.records():
                copy.take(record)
            writer.finish()
            out.flush()
            os.fsync(out.fileno())  # before it takes the place of the only one there is
            if walk.chunks_lost:
                path.replace(path.with_name(path.name + ".cut"))
            fresh.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be mended: {error.strerror}") from error
    return Recovered(path, copy.messages, walk.chunks_lost)


@contextlib.contextmanager
def _held(path: Path) -> Iterator[BinaryIO]:
    """Open a recording and lock it as its writer does: of two menders, one would cut off the other's new file."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{path}: is being written or mended by another process; nothing was done") from None
        if not os.path.samestat(os.fstat(stream.fileno()), path.stat()):
            raise InputError(f"{path}: was mended by another process meanwhile; nothing was done")
        yield stream


@contextlib.contextmanager
def _beside(fresh: Path, original: BinaryIO) -> Iterator[BinaryIO]:
    """Open the new file, readable for whom the original is; what is not put in its place is taken away again."""
    like = os.fstat(original.fileno())
    try:
        with fresh.open("wb") as out:
            make_alike(out.fileno(), like)
            yield out
    finally:
        fresh.unlink(missing_ok=True)


class _Walk:
    """The readable records of a file, from the front."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.chunks_lost = 0

    def records(self) -> Iterator[McapRecord]:
        """Yield schemas, channels, metadata and messages."""
        from mcap.opcode import Opcode

        while True:
            head = self._stream.read(_HEAD.size)
            if len(head) < _HEAD.size:
                return
            opcode, length = _HEAD.unpack(head)
            if not 1 <= opcode <= 0x0F or length > _LARGEST_RECORD:
                return
            body = self._stream.read(length)
            if len(body) < length or opcode == Opcode.DATA_END:
                return
            yield from self._parsed(opcode, head + body)

    def _parsed(self, opcode: int, record: bytes) -> Iterator[McapRecord]:
        from io import BytesIO

        from mcap.exceptions import McapError
        from mcap.opcode import Opcode
        from mcap.stream_reader import StreamReader
        from zstandard import ZstdError

        wanted = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK, Opcode.METADATA)
        if opcode not in wanted:
            return
        try:
            # whole or not at all: a chunk's messages only after its checksum was found right
            found = list(StreamReader(BytesIO(record + _END), skip_magic=True, validate_crcs=True).records)[:-1]
        except (McapError, ZstdError, struct.error, ValueError, MemoryError):
            self.chunks_lost += 1
            return
        yield from found


class _Copy:
    """Writes records into a new file under its own numbers."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schema_ids: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self.messages = 0

    def take(self, record: McapRecord) -> None:
        """Copy one record."""
        from mcap.records import Channel, Message, Metadata, Schema

        if isinstance(record, Schema) and record.id not in self._schema_ids:
            self._schema_ids[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in self._channels:
            self._channels[record.id] = self._channel(record)
        elif isinstance(record, Metadata):
            self._writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Message) and record.channel_id in self._channels:
            self._writer.add_message(
                self._channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
            )
            self.messages += 1

    def _channel(self, channel: Channel) -> int:
        schema = self._schema_ids.get(channel.schema_id, 0)
        number: int = self._writer.register_channel(channel.topic, channel.message_encoding, schema, channel.metadata)
        return number
