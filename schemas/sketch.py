"""A submap thinned for the radio: what a ground station's 3D view shows of the map."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from schemas.envelope import DecodeError

STEP_M = 0.01
"""Points are whole centimetres: a picture needs no more, and three int16 are half of three floats."""
_MAGIC = b"TDSK"
_HEADER = struct.Struct("<4sBBHQQq12dI")


@dataclass(frozen=True)
class SubmapSketch:
    """At most ``MAX_POINTS`` points of one submap, in an order in which every first part is an even sample of the whole.

    ``points_cm`` (N, 3) int16 in the submap's own frame, centimetres; ``colour`` (N, 3) uint8 RGB. ``T_map_submap``
    (4, 4) float64, metres, places it. Without points it moves one that was sent before (``moved``) or withdraws it
    (``removed``).
    """

    SCHEMA: ClassVar[str] = "treedock.submap_sketch"
    VERSION: ClassVar[int] = 1
    MAX_BYTES: ClassVar[int] = 48_000
    MAX_POINTS: ClassVar[int] = 5_000

    map_id: str
    submap_id: int
    version: int
    """Of the points, as in ``Submap``."""
    stamp_ns: int
    T_map_submap: NDArray[np.float64]
    points_cm: NDArray[np.int16] = field(repr=False)
    colour: NDArray[np.uint8] = field(repr=False)
    removed: bool = False

    @property
    def moved(self) -> bool:
        """Whether it tells a new place alone."""
        return not self.removed and len(self.points_cm) == 0

    @classmethod
    def encoding(cls) -> str:
        """Return the Zenoh encoding string."""
        return f"application/vnd.treedock.submap_sketch;v={cls.VERSION}"

    def to_bytes(self) -> bytearray:
        """Return the message as bytes: header, map_id, points, colours."""
        name = self.map_id.encode()
        header = _HEADER.pack(
            _MAGIC, self.VERSION, int(self.removed), len(name), self.submap_id, self.version, self.stamp_ns,
            *self.T_map_submap[:3].reshape(12), len(self.points_cm),
        )  # fmt: skip
        points = np.ascontiguousarray(self.points_cm, dtype="<i2").tobytes()
        return bytearray(header + name + points + np.ascontiguousarray(self.colour, dtype=np.uint8).tobytes())

    @classmethod
    def from_bytes(cls, data: bytes | bytearray | memoryview) -> SubmapSketch:
        """Parse a message.

        Raises:
            DecodeError: for anything but a whole sketch of this version.
        """
        view = memoryview(data)
        if not _HEADER.size <= len(view) <= cls.MAX_BYTES:
            raise DecodeError(f"sketch of {len(view)} bytes, expected {_HEADER.size}..{cls.MAX_BYTES}")
        magic, version, removed, name_len, *rest = _HEADER.unpack(view[: _HEADER.size])
        if magic != _MAGIC or version != cls.VERSION or removed > 1:
            raise DecodeError(f"not a sketch of version {cls.VERSION}")
        n = rest[-1]
        begin = _HEADER.size + name_len
        if len(view) != begin + 9 * n or n > cls.MAX_POINTS or (removed and n):
            raise DecodeError(f"sketch of {len(view)} bytes, its header says {n} points, removed {bool(removed)}")
        try:
            map_id = bytes(view[_HEADER.size : begin]).decode()
        except UnicodeDecodeError as error:
            raise DecodeError("sketch with a map_id that is not text") from error
        T = np.eye(4)
        T[:3] = np.array(rest[3:15]).reshape(3, 4)
        sketch = cls(
            map_id=map_id, submap_id=rest[0], version=rest[1], stamp_ns=rest[2], T_map_submap=T, removed=bool(removed),
            points_cm=np.frombuffer(view[begin : begin + 6 * n], dtype="<i2").reshape(n, 3),
            colour=np.frombuffer(view[begin + 6 * n :], dtype=np.uint8).reshape(n, 3),
        )  # fmt: skip
        sketch.check()
        return sketch

    def check(self) -> None:
        """Raise DecodeError when a value is impossible."""
        R = self.T_map_submap[:3, :3]
        if (
            not np.isfinite(self.T_map_submap).all()
            or not np.allclose(R @ R.T, np.eye(3), atol=1e-6)
            or np.linalg.det(R) < 0
        ):
            raise DecodeError(f"sketch of submap {self.submap_id} is placed by something that is no pose")
        if self.stamp_ns < 0 or len(self.map_id) > 200:
            raise DecodeError(f"sketch of submap {self.submap_id} with an impossible stamp or name")
