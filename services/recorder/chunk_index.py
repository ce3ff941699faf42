"""The index of the file being written, kept small: the library keeps 2 KB for each chunk until the file is closed.

Two chunks a second are 16 MB an hour. Packed they are 1 MB, and a file of the greatest size (``recorder.file_mb``) that holds
frames has a quarter of that.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from mcap.data_stream import RecordBuilder

if TYPE_CHECKING:
    from mcap.records import ChunkIndex
    from mcap.writer import Writer

_LIST = "_Writer__chunk_indices"
"""The library's own list: appended to for each chunk, walked through once at the end, each entry told to write itself."""


class PackedRecords:
    """Index records as the bytes that they will be in the file, compressed."""

    def __init__(self) -> None:
        self._packer = zlib.compressobj()
        self._packed = bytearray()

    def append(self, index: ChunkIndex) -> None:
        """Take one more record."""
        builder = RecordBuilder()
        index.write(builder)
        self._packed += self._packer.compress(builder.end())

    def __iter__(self) -> Iterator[PackedRecords]:
        """Give what writes them all; to the library a list of one."""
        yield self

    def write(self, builder: RecordBuilder) -> None:
        """Write all records, in the order in which they came."""
        builder.write(zlib.decompress(bytes(self._packed) + self._packer.copy().flush()))

    @property
    def size(self) -> int:
        """Return how many bytes are kept."""
        return len(self._packed)


def keep_small(writer: Writer) -> PackedRecords:
    """Have a writer that has written no chunk yet keep its index packed; return what is kept.

    Raises:
        RuntimeError: the library is not the one that this was written for.
    """
    if getattr(writer, _LIST, None) != []:
        raise RuntimeError(
            "mcap.writer.Writer keeps its index otherwise than mcap 1.6: look at services/recorder/chunk_index.py"
        )
    records = PackedRecords()
    setattr(writer, _LIST, records)
    return records
