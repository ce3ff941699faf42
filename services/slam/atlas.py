"""Owns the map's arrays (``links``): hands out slots and grows them.

Room for a long flight is reserved at once, in pages that the machine gives only when they are first written: growing is
taking a longer part of it. Arrays that doubled were both there while one was copied into the other, and what the old one
left behind stayed with the process.
"""

from __future__ import annotations

import mmap
from typing import TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from services.slam.features import Features
from services.slam.links import MAX_OBSERVATIONS, Keyframes, Points, observe_all, shared_counts

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

T = TypeVar("T", Points, Keyframes)

_POINTS, _KEYFRAMES = 1 << 18, 1 << 10
"""Reserved at first; a larger map is copied into twice the room."""
_FIRST_POINTS, _FIRST_KEYFRAMES = 4096, 16
_MOST_KEYFRAMES = 1 << 15
"""Points name them in two bytes. They would take 2.3 GB."""


def _zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray:
    """Return zeros whose memory is taken from the machine page by page as it is written, and given back with them."""
    kind = np.dtype(dtype)
    room = mmap.mmap(-1, int(np.prod(shape)) * kind.itemsize, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(room, kind).reshape(shape)


def _points(n: int) -> Points:
    m, i16, i32, f64 = MAX_OBSERVATIONS, np.int16, np.int32, np.float64
    return Points(
        _zeros((n, 3), f64), _zeros((n, 3), f64), _zeros((n,), f64), _zeros((n,), f64), _zeros((n, 4), np.uint64),
        _zeros((n, m), i16), _zeros((n, m), i16), _zeros((n,), i32), _zeros((n,), i32), _zeros((n,), i32),
        _zeros((n,), i32), _zeros((n,), f64),
    )  # fmt: skip


def _keyframes(k: int, n: int, cells: int) -> Keyframes:
    f32, i32, f64 = np.float32, np.int32, np.float64
    return Keyframes(
        _zeros((k, 3, 3), f64), _zeros((k, 3), f64), _zeros((k, n, 2), f32), _zeros((k, n), f32), _zeros((k, n), f32),
        _zeros((k, n), np.bool_), _zeros((k, n), f32),
        _zeros((k, n), i32), _zeros((k, n), f32), _zeros((k, n, 4), np.uint64), _zeros((k, n), i32),
        _zeros((k,), i32), _zeros((k,), i32), _zeros((k, cells + 1), i32), _zeros((k, n), i32),
    )  # fmt: skip


def _first(room: T, n: int) -> T:
    """Return the first ``n`` rows of all arrays."""
    arrays: tuple[NDArray, ...] = tuple(room)
    return type(room)._make(array[:n] for array in arrays)


def _copied(old: T, room: T) -> T:
    """Return ``room`` with ``old`` in its beginning."""
    new_arrays: tuple[NDArray, ...] = tuple(room)
    old_arrays: tuple[NDArray, ...] = tuple(old)
    for new, array in zip(new_arrays, old_arrays, strict=True):
        new[: len(array)] = array
    return room


class Atlas:
    """Owns the arrays, hands out slots and grows."""

    def __init__(self, features: int, cells: int, scale: float, levels: int) -> None:
        self._point_room, self._keyframe_room = _points(_POINTS), _keyframes(_KEYFRAMES, features, cells)
        self.points = _first(self._point_room, _FIRST_POINTS)
        self.keyframes = _first(self._keyframe_room, _FIRST_KEYFRAMES)
        self.points.parallax[:] = -1.0
        self.keyframes.serial[:] = -1
        self.scales = scale ** np.arange(levels, dtype=float)
        self._features = features
        self._cells = cells
        self._serial = 0

    @property
    def slots(self) -> I32:
        """Return the living keyframes' slots in order of their serial."""
        alive = np.flatnonzero(self.keyframes.n > 0)
        return alive[np.argsort(self.keyframes.serial[alive], kind="stable")].astype(np.int32)

    @property
    def newest_serial(self) -> int:
        """Return the serial of the last keyframe made, -1 before the first."""
        return self._serial - 1

    def next_serial(self, serial: int) -> None:
        """Give the next keyframe this serial; only upward, for a map that is put together again."""
        self._serial = max(self._serial, serial)

    def reserve_points(self, count: int) -> I32:
        """Return ``count`` free point slots, lowest first; they stay free until observed."""
        free = np.flatnonzero(self.points.n == 0)
        if len(free) < count:
            self._grow_points(2 * len(self.points.n) + count)
            free = np.flatnonzero(self.points.n == 0)
        return free[:count].astype(np.int32)

    def _grow_points(self, n: int) -> None:
        old = self.points
        if n > len(self._point_room.n):
            self._point_room = _copied(old, _points(2 * n))
        self.points = _first(self._point_room, n)
        self.points.parallax[len(old.n) :] = -1.0

    def _grow_keyframes(self, k: int) -> None:
        if k > _MOST_KEYFRAMES:
            raise MemoryError(f"the map holds {_MOST_KEYFRAMES} keyframes, and no more are possible")
        old = self.keyframes
        if k > len(self._keyframe_room.n):
            self._keyframe_room = _copied(old, _keyframes(2 * k, self._features, self._cells))
        self.keyframes = _first(self._keyframe_room, k)
        self.keyframes.serial[len(old.n) :] = -1

    def add_keyframe(self, features: Features, R: F64, t: F64, point: I32) -> int:
        """Store a keyframe seen from ``R``, ``t`` (camera from map) whose features see ``point``; return its slot."""
        free = np.flatnonzero(self.keyframes.n == 0)
        if not len(free):
            self._grow_keyframes(2 * len(self.keyframes.n))
            free = np.flatnonzero(self.keyframes.n == 0)
        k, n, kf = int(free[0]), len(features), self.keyframes
        kf.R[k], kf.t[k], kf.n[k], kf.serial[k] = R, t, n, self._serial
        still = features.moving_s == 0.0  # what moves makes no points
        kf.uv[k, :n], kf.depth[k, :n], kf.disparity[k, :n] = (
            features.uv,
            still * features.depth,
            still * features.disparity,
        )
        kf.far[k, :n], kf.info[k, :n] = features.far & still, still * features.info
        kf.octave[k, :n], kf.angle[k, :n], kf.desc[k, :n] = features.octave, features.angle, features.desc
        kf.cell_start[k], kf.cell_items[k, :n] = features.cell_start, features.cell_items
        kf.point[k] = -1
        self._serial += 1
        observe_all(self.points, kf, k, point)
        return k

    def keyframe_poses(self) -> dict[int, F64]:
        """Return T_map_camera (4, 4) of each living keyframe by id, in order of id."""
        kf, slots = self.keyframes, self.slots
        T = np.tile(np.eye(4), (len(slots), 1, 1))
        T[:, :3, :3] = kf.R[slots].transpose(0, 2, 1)
        T[:, :3, 3] = -np.einsum("nba,nb->na", kf.R[slots], kf.t[slots])
        return dict(zip(kf.serial[slots].tolist(), T, strict=True))

    def features_of(self, k: int) -> Features:
        """Return a keyframe's features as they were extracted."""
        kf, n = self.keyframes, int(self.keyframes.n[k])
        return Features(
            kf.uv[k, :n].astype(float), kf.octave[k, :n].copy(), kf.angle[k, :n].astype(float), kf.desc[k, :n].copy(),
            kf.depth[k, :n].astype(float), kf.disparity[k, :n].astype(float), kf.far[k, :n].copy(), kf.info[k, :n].astype(float), kf.cell_start[k].copy(),
            kf.cell_items[k, :n].copy(),
        )  # fmt: skip

    def slot_of(self, serial: int) -> int:
        """Return the slot of a living keyframe, or -1."""
        where = np.flatnonzero((self.keyframes.serial == serial) & (self.keyframes.n > 0))
        return int(where[0]) if len(where) else -1


def neighbours(atlas: Atlas, k: int, least: int, most: int) -> I32:
    """Return up to ``most`` keyframes that share at least ``least`` points with ``k``, most shared first."""
    kf = atlas.keyframes
    counts = shared_counts(atlas.points, kf.point[k], len(kf.n))
    counts[k] = 0
    order = np.lexsort((kf.serial, -counts))
    order = order[counts[order] >= least]
    return order[:most].astype(np.int32)
