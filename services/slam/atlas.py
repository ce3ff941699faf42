"""Owns the map's arrays (``links``): hands out slots and grows them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.slam.features import Features
from services.slam.links import MAX_OBSERVATIONS, Keyframes, Points, observe_all, shared_counts

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


def _points(n: int) -> Points:
    m = MAX_OBSERVATIONS
    return Points(
        np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros((n, 4), np.uint64),
        np.zeros((n, m), np.int32), np.zeros((n, m), np.int32), np.zeros(n, np.int32), np.zeros(n, np.int32),
        np.zeros(n, np.int32), np.zeros(n, np.int32), np.full(n, -1.0),
    )  # fmt: skip


def _keyframes(k: int, n: int, cells: int) -> Keyframes:
    f32, i32 = np.float32, np.int32
    return Keyframes(
        np.zeros((k, 3, 3)), np.zeros((k, 3)), np.zeros((k, n, 2), f32), np.zeros((k, n), f32), np.zeros((k, n), f32),
        np.zeros((k, n), np.bool_), np.zeros((k, n), f32),
        np.zeros((k, n), i32), np.zeros((k, n), f32), np.zeros((k, n, 4), np.uint64), np.full((k, n), -1, i32),
        np.zeros(k, i32), np.full(k, -1, i32), np.zeros((k, cells + 1), i32), np.zeros((k, n), i32),
    )  # fmt: skip


def copy_over(grown: Points | Keyframes, old: Points | Keyframes) -> None:
    """Copy all arrays of ``old`` into the beginnings of those of ``grown``."""
    new_arrays: tuple[NDArray, ...] = tuple(grown)
    old_arrays: tuple[NDArray, ...] = tuple(old)
    for a, b in zip(new_arrays, old_arrays, strict=True):
        a[: len(b)] = b


class Atlas:
    """Owns the arrays, hands out slots and grows."""

    def __init__(self, features: int, cells: int, scale: float, levels: int) -> None:
        self.points = _points(4096)
        self.keyframes = _keyframes(16, features, cells)
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
            old = self.points
            grown = _points(2 * len(old.n) + count)
            copy_over(grown, old)
            self.points = grown
            free = np.flatnonzero(grown.n == 0)
        return free[:count].astype(np.int32)

    def add_keyframe(self, features: Features, R: F64, t: F64, point: I32) -> int:
        """Store a keyframe seen from ``R``, ``t`` (camera from map) whose features see ``point``; return its slot."""
        free = np.flatnonzero(self.keyframes.n == 0)
        if not len(free):
            old = self.keyframes
            grown = _keyframes(2 * len(old.n), self._features, self._cells)
            copy_over(grown, old)
            self.keyframes = grown
            free = np.flatnonzero(grown.n == 0)
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
