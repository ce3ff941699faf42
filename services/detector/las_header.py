"""Does a LAS or LAZ header announce more than its file can hold? Looked at before laspy believes it.

A damaged count of records (of which there may be four thousand million) keeps laspy reading, and its memory growing, for
as long as it takes. Offsets: ASPRS LAS 1.4 R15, table 3.
"""

from __future__ import annotations

import struct
from pathlib import Path

_HEAD_BYTES = 375
_VLR_BYTES, _EVLR_BYTES = 54, 60
_COMPRESSED = 0x80
"""Set by LAZ in the point format."""


def announced_too_much(path: Path) -> str:
    """Return in words what the header announces and the file cannot hold; empty when it may hold it all."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES).ljust(_HEAD_BYTES, b"\0")
    begin, records = struct.unpack_from("<II", head, 96)
    kind, length, points = struct.unpack_from("<BHI", head, 104)
    late_records = 0
    if head[25] >= 4:  # the minor version
        late_records, points_now = struct.unpack_from("<IQ", head, 243)
        points = max(points, points_now)
    if records * _VLR_BYTES + late_records * _EVLR_BYTES > size:
        return f"{records + late_records} records in {size} bytes"
    if not kind & _COMPRESSED and begin + points * length > size:
        return f"{points} points of {length} bytes in {size} bytes"
    return _chunks_too_many(path, begin, size) if kind & _COMPRESSED else ""


def is_compressed(path: Path) -> bool:
    """Return whether a file's points are LAZ, whatever its name says."""
    with path.open("rb") as stream:
        head = stream.read(105)
    return len(head) == 105 and bool(head[104] & _COMPRESSED)


def _chunks_too_many(path: Path, begin: int, size: int) -> str:
    """Return in words how many chunks a LAZ file announces and cannot hold: room is made for all of them before the first is read.

    What cannot be had ends the process then, not the reading: the decompressor is Rust, and there is nothing to catch. Where the
    points ``begin`` stands the chunk table's offset, -1: it is the file's last number. Isenburg, "LASzip" (2013), section 5.
    """
    with path.open("rb") as stream:
        stream.seek(begin)
        place = stream.read(8)
        if place == b"\xff" * 8:
            stream.seek(max(size - 8, 0))
            place = stream.read(8)
        if len(place) < 8:
            return ""
        (table,) = struct.unpack("<q", place)
        if not begin < table <= size - 8:
            return ""
        stream.seek(table)
        _, chunks = struct.unpack("<II", stream.read(8))
    return f"{chunks} chunks in {size} bytes" if chunks > table - begin else ""
