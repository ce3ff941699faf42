"""The dense map as deltas: one binary message per submap, placed by its own pose."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from schemas.envelope import DecodeError


@dataclass(frozen=True)
class Submap:
    """Points of one submap (one or a few keyframes) in the submap's own frame.

    ``points_m`` (N, 3) float32 in the submap frame; ``view`` (N,) uint16 names for each point the row of
    ``origins_m`` (V, 3) float32, the camera centre it was seen from, so that view rays are known;
    ``colour`` (N, 3) uint8 RGB or (0, 3). ``T_map_submap`` (4, 4) float64 places it. An empty submap with
    ``removed`` true withdraws an earlier one.
    """

    SCHEMA: ClassVar[str] = "treedock.submap"
    VERSION: ClassVar[int] = 1
    MAX_BYTES: ClassVar[int] = 64 * 1024 * 1024

    map_id: str
    submap_id: int
    version: int
    """Of the points: a changed pose alone keeps it."""
    graph_version: int
    stamp_ns: int
    T_map_submap: NDArray[np.float64]
    points_m: NDArray[np.float32] = field(repr=False)
    view: NDArray[np.uint16] = field(repr=False)
    origins_m: NDArray[np.float32] = field(repr=False)
    colour: NDArray[np.uint8] = field(repr=False)
    removed: bool = False

    @classmethod
    def encoding(cls) -> str:
        """Return the Zenoh encoding string."""
        return f"application/vnd.treedock.submap;v={cls.VERSION}"

    def to_bytes(self) -> bytearray:
        """Return the message as bytes: header, map_id, points, view, origins, colour."""
        name = self.map_id.encode()
        header = _HEADER.pack(
            _MAGIC, self.VERSION, int(self.removed), len(name), self.submap_id, self.version, self.graph_version,
            self.stamp_ns, *self.T_map_submap[:3].reshape(12), len(self.points_m), len(self.origins_m), len(self.colour),
        )  # fmt: skip
        out = bytearray(header + name)
        for array, kind in self._arrays():
            out += np.ascontiguousarray(array, dtype=kind).tobytes()
        return out

    def _arrays(self) -> tuple[tuple[NDArray[np.generic], str], ...]:
        return ((self.points_m, "<f4"), (self.view, "<u2"), (self.origins_m, "<f4"), (self.colour, "u1"))

    @classmethod
    def from_bytes(cls, data: bytes | bytearray | memoryview) -> Submap:
        """Parse a message.

        Raises:
            DecodeError: for anything but a whole, finite submap of this version.
        """
        view = memoryview(data)
        if not _HEADER.size <= len(view) <= cls.MAX_BYTES:
            raise DecodeError(f"submap of {len(view)} bytes, expected {_HEADER.size}..{cls.MAX_BYTES}")
        values = _HEADER.unpack(view[: _HEADER.size])
        if values[0] != _MAGIC or values[1] != cls.VERSION:
            raise DecodeError(f"not a submap of version {cls.VERSION}")
        name_len = values[3]
        n, n_views, n_colour = values[-3:]
        expected = _HEADER.size + name_len + n * 14 + n_views * 12 + n_colour * 3
        if len(view) != expected:
            raise DecodeError(f"submap has {len(view)} bytes, its header says {expected}")
        if n_colour not in (0, n):
            raise DecodeError(f"submap with {n_colour} colours for {n} points")
        try:
            map_id = bytes(view[_HEADER.size : _HEADER.size + name_len]).decode()
        except UnicodeDecodeError as error:
            raise DecodeError("submap with a map_id that is not text") from error
        T = np.eye(4)
        T[:3] = np.array(values[8:20]).reshape(3, 4)
        cursor = _HEADER.size + name_len
        arrays = []
        for count, columns, kind in ((n, 3, "<f4"), (n, 1, "<u2"), (n_views, 3, "<f4"), (n_colour, 3, "u1")):
            size = count * columns * np.dtype(kind).itemsize
            arrays.append(np.frombuffer(view[cursor : cursor + size], dtype=kind).reshape(count, columns))
            cursor += size
        submap = cls(
            map_id=map_id, submap_id=values[4], version=values[5], graph_version=values[6], stamp_ns=values[7],
            T_map_submap=T, points_m=arrays[0], view=arrays[1].reshape(n), origins_m=arrays[2], colour=arrays[3],
            removed=bool(values[2]),
        )  # fmt: skip
        submap.check()
        return submap

    def check(self) -> None:
        """Raise DecodeError when a value is impossible."""
        finite = (
            np.isfinite(self.points_m).all()
            and np.isfinite(self.origins_m).all()
            and np.isfinite(self.T_map_submap).all()
        )
        if not finite:
            raise DecodeError(f"submap {self.submap_id} holds NaN or infinity")
        R = self.T_map_submap[:3, :3]
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise DecodeError(f"submap {self.submap_id} is placed by something that is no rotation")
        if len(self.view) and int(self.view.max()) >= len(self.origins_m):
            raise DecodeError(f"submap {self.submap_id} names view {int(self.view.max())} of {len(self.origins_m)}")
        if self.stamp_ns < 0:
            raise DecodeError(f"submap {self.submap_id} with the negative stamp {self.stamp_ns}")


_MAGIC = b"TDSM"
_HEADER = struct.Struct("<4sBBHQQQq12dIII")
