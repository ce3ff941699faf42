"""One MCAP file being written: our messages as they are, Foxglove's beside them."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Self

from services.common.errors import InputError

if TYPE_CHECKING:
    from google.protobuf.message import Message as ProtobufMessage

CHUNK_BYTES = 512 * 1024
SCHEMA_ENCODING = "treedock"
"""Not one of MCAP's well-known encodings: the layouts are in schemas/."""
PROFILE = "treedock"


class McapFile:
    """Appends messages; ``flush`` makes everything so far safe, ``close`` writes the index.

    The file is locked while it is written: who looks for cut recordings leaves it alone.
    """

    def __init__(self, path: Path, about: dict[str, str] | None = None) -> None:
        from mcap.writer import CompressionType, Writer

        from services.recorder.chunk_index import keep_small

        try:
            self._file: BinaryIO = path.open("xb")
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from error
        self.path = path
        self.messages = 0
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._index = keep_small(self._writer)
        self._writer.start(profile=PROFILE, library="treedock")
        if about:
            self._writer.add_metadata("treedock", about)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._safe_bytes = 0
        self.flush()

    @property
    def size(self) -> int:
        """Return the bytes written so far."""
        return self._file.tell()

    @property
    def index_bytes(self) -> int:
        """Return what is kept in memory of the index that ``close`` will write."""
        return self._index.size

    def add(self, key: str, schema: str, encoding: str, data: bytes, stamp_ns: int, seq: int = 0) -> None:
        """Append one of our messages under its key.

        Raises:
            OSError: the disk refused.
        """
        channel = self._channels.get(key)
        if channel is None:
            known = self._schemas.get(schema)
            if known is None:
                known = self._schemas[schema] = self._writer.register_schema(schema, SCHEMA_ENCODING, b"")
            channel = self._channels[key] = self._writer.register_channel(key, encoding, known)
        self._append(channel, data, stamp_ns, seq)

    def add_foxglove(self, key: str, message: ProtobufMessage, stamp_ns: int) -> None:
        """Append a message of one of Foxglove's protobuf schemas.

        Raises:
            OSError: the disk refused.
        """
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = self._writer.register_channel(key, "protobuf", self._schema_of(message))
        self._append(channel, message.SerializeToString(), stamp_ns, 0)

    def _schema_of(self, message: ProtobufMessage) -> int:
        from mcap_protobuf.schema import register_schema

        name: str = message.DESCRIPTOR.full_name
        if name not in self._schemas:
            register: Any = register_schema
            self._schemas[name] = register(self._writer, type(message))
        return self._schemas[name]

    def _append(self, channel: int, data: bytes, stamp_ns: int, seq: int) -> None:
        self._writer.add_message(channel, stamp_ns, data, stamp_ns, seq & 0xFFFFFFFF)
        self.messages += 1

    def flush(self, *, to_disk: bool = True) -> None:
        """End the open chunk and hand everything to the disk.

        Raises:
            OSError: the disk refused.
        """
        self._writer.flush()
        if to_disk:
            os.fsync(self._file.fileno())
        self._safe_bytes = self._file.tell()

    def close(self) -> None:
        """Write the index and close.

        Raises:
            OSError: the disk refused; the file is left readable, without an index.
        """
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError:
            self.abandon()
            raise
        self._file.close()

    def abandon(self) -> None:
        """Cut the file after the last flush and close it without an index: what is in it stays readable."""
        fd = self._file.fileno()
        try:
            os.ftruncate(fd, self._safe_bytes)
        finally:
            self._file.raw.close() if hasattr(self._file, "raw") else self._file.close()

    def __enter__(self) -> Self:
        """Return the file."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write the index and close."""
        self.close()
