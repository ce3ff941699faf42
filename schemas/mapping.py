"""The dense map as deltas: one binary message per submap, placed by its own pose; what it holds; the ground under it."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from schemas.envelope import Counter, DecodeError, Message, Name, Part, StampNs


@dataclass(frozen=True)
class Submap:
    """Points of one submap (one or a few keyframes) in the submap's own frame.

    ``points_m`` (N, 3) float32 in the submap frame; ``view`` (N,) uint16 names for each point the row of
    ``origins_m`` (V, 3) float32, the camera centre it was seen from, so that view rays are known;
    ``colour`` (N, 3) uint8 RGB or (0, 3). ``T_map_submap`` (4, 4) float64 places it. A submap without points moves the
    points sent before; with ``removed`` true it withdraws them.
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

    def after(self, held: Submap | None) -> Submap | None:
        """Return what there is of the submap after this message, ``held`` being what there was before it.

        A message without points moves the points that are held; None: there is nothing (any more).
        """
        if self.removed:
            return None
        if len(self.points_m):
            return self
        if held is None or held.map_id != self.map_id:
            return None
        return replace(held, T_map_submap=self.T_map_submap, graph_version=self.graph_version, stamp_ns=self.stamp_ns)

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


Cell = Annotated[int, Field(ge=-(2**31), lt=2**31)]


class MapIndex(Message):
    """What the mapper holds: a consumer that holds anything else has missed a delta and asks ``map/cloud`` for it.

    The three lists run side by side, one entry for each submap that has points.
    """

    SCHEMA: ClassVar[str] = "treedock.map_index"
    MAX_BYTES: ClassVar[int] = 8 * 1024 * 1024

    stamp_ns: StampNs
    map_id: Name
    epoch: Counter
    """Names this run of the mapper: versions of another run say nothing about the points of this one."""
    graph_version: Counter
    submap_ids: Annotated[tuple[Counter, ...], Field(max_length=200_000)]
    versions: Annotated[tuple[Counter, ...], Field(max_length=200_000)]
    """Of each submap's points."""
    placed_by: Annotated[tuple[Counter, ...], Field(max_length=200_000)]
    """Version of the graph under which each submap was last sent: an older place is out of date."""
    ground_sequence: Counter = 0
    """Of the last ``map/ground``."""

    @model_validator(mode="after")
    def _side_by_side(self) -> Self:
        if not len(self.submap_ids) == len(self.versions) == len(self.placed_by):
            raise ValueError(
                f"{len(self.submap_ids)} submaps, {len(self.versions)} versions and {len(self.placed_by)} places: one of each was expected"
            )
        return self


class SubmapsWanted(Message):
    """A query of ``map/cloud`` that asks for some submaps: who misses a few does not need the whole map again.

    The mapper answers with those that it has, if its map is the one named; without this payload it answers with all.
    """

    SCHEMA: ClassVar[str] = "treedock.submaps_wanted"

    map_id: Name
    submap_ids: Annotated[tuple[Counter, ...], Field(min_length=1, max_length=1000)]


class GroundCell(Part):
    """The ground in one square cell of the map: ``z = height + slope_x (x - xc) + slope_y (y - yc)``, (xc, yc) its centre."""

    column: Cell
    """The cell covers ``column * cell_m <= x < (column + 1) * cell_m``, ``row`` the same along y."""
    row: Cell
    height_m: float
    """z of the ground at the cell's centre."""
    slope_x: float
    slope_y: float
    """Metres up per metre along x and y."""
    relief_m: Annotated[float, Field(ge=0.0)]
    """Roughness: half the width that holds the middle 68 % of the ground points about the plane."""
    points: Annotated[int, Field(ge=0)]
    """Ground points that the plane rests on; 0: none in this cell, it is what the neighbours say."""


class GroundPatch(Message):
    """Cells of the ground model that changed, in ``map``; each replaces what was said of it before."""

    SCHEMA: ClassVar[str] = "treedock.ground"
    MAX_BYTES: ClassVar[int] = 4 * 1024 * 1024

    stamp_ns: StampNs
    map_id: Name
    graph_version: Counter
    sequence: Counter
    """One more with each patch: after a gap ask ``map/ground`` for the whole."""
    cell_m: Annotated[float, Field(gt=0.0)]
    cells: Annotated[tuple[GroundCell, ...], Field(max_length=20_000)]
    gone: Annotated[tuple[tuple[Cell, Cell], ...], Field(max_length=20_000)] = ()
    """(column, row) of cells that have no ground any more."""
