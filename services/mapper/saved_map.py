"""The map as bytes: whole and checked, or refused with the reason."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.envelope import DecodeError
from schemas.mapping import Submap
from services.mapper.dense_map import MapSubmap

FORMAT = 1
_MAGIC = b"treedock map\n"
_END = b"end of map\n"
_HEAD = struct.Struct("<II")
"""Length and CRC-32 of what follows."""
_ANCHOR = struct.Struct("<Q12d")
_MAX_PART = Submap.MAX_BYTES + _ANCHOR.size
_ORIGIN = np.zeros((1, 3), dtype=np.float32)


class SavedMapError(ValueError):
    """Bytes that are no whole saved map; the text says what is wrong with them."""


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map as it was when it was saved."""

    map_id: str
    graph_version: int
    submaps: list[MapSubmap] = field(repr=False)


def pack(saved: SavedMap) -> Iterator[bytes]:
    """Yield the bytes of a saved map: magic, header, submaps, end; each part with its length and checksum."""
    header = {
        "format": FORMAT, "map_id": saved.map_id, "graph_version": saved.graph_version, "submaps": len(saved.submaps),
    }  # fmt: skip
    yield _MAGIC + _part(json.dumps(header).encode())
    for submap in saved.submaps:
        anchor = _ANCHOR.pack(submap.anchor_id, *submap.T_anchor_submap[:3].reshape(12))
        yield _part(anchor + bytes(as_message(submap, saved.map_id, saved.graph_version, points=True).to_bytes()))
    yield _END


def unpack(data: bytes) -> SavedMap:
    """Return the map in ``data``.

    Raises:
        SavedMapError: cut short, damaged, of another format, or no map at all.
    """
    if not data.startswith(_MAGIC):
        raise SavedMapError(f"does not begin as a saved map ({len(data)} bytes)")
    body, at = _read_part(data, len(_MAGIC), "header")
    try:
        header = json.loads(body)
        form, count = header["format"], int(header["submaps"])
        map_id, graph_version = str(header["map_id"]), int(header["graph_version"])
    except (ValueError, KeyError, TypeError) as error:
        raise SavedMapError(f"its header is not understood: {error}") from None
    if form != FORMAT:
        raise SavedMapError(f"is of format {form}, this version reads {FORMAT}")
    submaps = []
    for number in range(count):
        body, at = _read_part(data, at, f"submap {number + 1} of {count}")
        submaps.append(_submap(body, number, map_id))
    if data[at:] != _END:
        raise SavedMapError(f"does not end after its {count} submaps")
    return SavedMap(map_id, graph_version, submaps)


def as_message(submap: MapSubmap, map_id: str, graph_version: int, *, points: bool, removed: bool = False) -> Submap:
    """Return the message of a submap, with its points or without."""
    n = len(submap.points_m) if points else 0
    return Submap(
        map_id=map_id, submap_id=submap.submap_id, version=submap.version, graph_version=graph_version,
        stamp_ns=submap.stamp_ns, T_map_submap=submap.T_map_submap.copy(), points_m=submap.points_m[:n],
        view=np.zeros(n, dtype=np.uint16), origins_m=_ORIGIN, colour=submap.rgb[:n], removed=removed,
    )  # fmt: skip


def map_file(folder: Path, uav: str) -> Path:
    """Return the file of an aircraft's map in the folder of its state."""
    return folder / f"map-{uav}.tdmap"


def _part(body: bytes) -> bytes:
    return _HEAD.pack(len(body), zlib.crc32(body)) + body


def _read_part(data: bytes, at: int, what: str) -> tuple[bytes, int]:
    if at + _HEAD.size > len(data):
        raise SavedMapError(f"ends before its {what}")
    size, checksum = _HEAD.unpack_from(data, at)
    begin = at + _HEAD.size
    if size > _MAX_PART or begin + size > len(data):
        raise SavedMapError(f"ends within its {what}")
    body = data[begin : begin + size]
    if zlib.crc32(body) != checksum:
        raise SavedMapError(f"its {what} is damaged (checksum)")
    return body, begin + size


def _submap(body: bytes, number: int, map_id: str) -> MapSubmap:
    try:
        anchor_id, *values = _ANCHOR.unpack_from(body)
        message = Submap.from_bytes(body[_ANCHOR.size :])
    except (struct.error, DecodeError) as error:
        raise SavedMapError(f"submap {number + 1}: {error}") from None
    T: NDArray[np.float64] = np.eye(4)
    T[:3] = np.array(values).reshape(3, 4)
    if message.map_id != map_id or not np.isfinite(T).all() or len(message.colour) != len(message.points_m):
        raise SavedMapError(f"submap {number + 1} does not belong to the map {map_id}")
    return MapSubmap(
        message.submap_id, message.stamp_ns, message.points_m.astype(np.float32),
        message.colour.copy(), message.T_map_submap, message.version, anchor_id, T,
    )  # fmt: skip
