"""Local mapping: what happens to the map when a keyframe joins it."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.geometry import inverse, pose
from services.slam.atlas import Atlas, neighbours
from services.slam.bundle import adjust, adjust_large, build, chi_squares
from services.slam.camera import CameraModel
from services.slam.config import SlamConfig
from services.slam.features import Features
from services.slam.links import (
    Keyframes,
    Points,
    create_points,
    describe,
    forget,
    merge,
    observe,
    points_of,
    remove_keyframe,
    remove_point,
    shared_counts,
)
from services.slam.match import match_windows, project
from services.slam.observe import CHI2_DEPTH, CHI2_MONO
from services.slam.refine import gate

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

MATCH_STRICT = 50
"""Hamming distance below which two descriptors are taken for one corner."""
_COMPILED_KEYFRAMES = 24
"""Above this the cameras' system is large enough to pay for LAPACK."""


class Mapping:
    """Keeps the map consistent and small; not aware of frames between keyframes."""

    def __init__(self, atlas: Atlas, camera: CameraModel, config: SlamConfig) -> None:
        self.atlas = atlas
        self.camera = camera
        self.config = config
        self.retired: dict[int, tuple[int, F64]] = {}
        """Culled keyframes: serial -> (serial of its stand-in, T_standin_keyframe)."""
        self._recent = np.zeros((0, 2), np.int32)

    def insert(self, features: Features, R: F64, t: F64, point: I32) -> int:
        """Add a keyframe with its matches and tidy the map around it; return its slot."""
        atlas = self.atlas
        k = atlas.add_keyframe(features, R, t, point)
        self._recent = cull_recent(atlas.points, atlas.keyframes, self._recent, atlas.newest_serial)
        self._create(k)
        self._fuse(k)
        self.adjust_window(k)
        self._cull_keyframes(k)
        return k

    def _create(self, k: int) -> None:
        atlas, config = self.atlas, self.config
        slots = atlas.reserve_points(int(atlas.keyframes.n[k]))
        made = create_points(
            atlas.points,
            atlas.keyframes,
            k,
            slots,
            self.camera.array,
            config.min_depth_m,
            config.max_depth_m,
            config.far_m,
            atlas.scales,
        )
        born = np.full(made, atlas.newest_serial, np.int32)
        self._recent = np.concatenate([self._recent, np.stack([slots[:made], born], axis=1)])

    def _fuse(self, k: int) -> None:
        atlas = self.atlas
        near = neighbours(atlas, k, 10, 10)
        own = points_of(atlas.points, atlas.keyframes, np.array([k], np.int32))
        for other in near:
            self.fuse_into(int(other), own)
        self.fuse_into(k, points_of(atlas.points, atlas.keyframes, near))
        describe_all(atlas.points, atlas.keyframes, k, atlas.scales)

    def fuse_into(self, k: int, ids: I32) -> int:
        """Find points ``ids`` among the features of keyframe ``k``; return how many were joined."""
        atlas, camera = self.atlas, self.camera
        return fuse(
            atlas.points, atlas.keyframes, k, ids, camera.array, camera.variance, atlas.scales,
            camera.cols, camera.width, camera.height,
        )  # fmt: skip

    def adjust_window(self, k: int) -> None:
        """Bundle adjustment of keyframe ``k``, its neighbours and all they see; observers outside hold still."""
        atlas = self.atlas
        kf = atlas.keyframes
        window = np.concatenate([[k], neighbours(atlas, k, 15, self.config.window_keyframes - 1)])
        window = window[kf.serial[window] != 0].astype(np.int32)
        ids = points_of(atlas.points, kf, window)
        counts = shared_counts(atlas.points, ids, len(kf.n))
        counts[window] = 0
        order = np.lexsort((kf.serial, -counts))
        fixed = order[counts[order] > 0][: 2 * self.config.window_keyframes]
        self.adjust(ids, window, fixed.astype(np.int32), 5, 5)

    def adjust_all(self) -> None:
        """Bundle adjustment of every keyframe but the first, and every point."""
        slots = self.atlas.slots
        ids = points_of(self.atlas.points, self.atlas.keyframes, slots)
        self.adjust(ids, slots[1:], slots[:1], 10, 10)

    def adjust(self, ids: I32, free: I32, fixed: I32, robust_iterations: int, iterations: int) -> None:
        """Adjust ``free`` keyframes and points ``ids``, then drop the observations that do not fit."""
        atlas, camera = self.atlas, self.camera
        kf = atlas.keyframes
        if not len(free) or not len(ids):
            return
        slots = np.concatenate([free, fixed]).astype(np.int32)
        index = np.full(len(kf.n), -1, np.int32)
        index[slots] = np.arange(len(slots))
        problem = build(atlas.points, kf, ids, slots, index, camera.variance, camera.far)
        solve = adjust if len(free) <= _COMPILED_KEYFRAMES else adjust_large
        solve(problem, camera.array, len(free), robust_iterations, robust=True)
        gate(chi_squares(problem, camera.array), problem.info, 1.0, problem.use)
        solve(problem, camera.array, len(free), iterations, robust=False)
        gate(chi_squares(problem, camera.array), problem.info, 1.0, problem.use)
        kf.R[free], kf.t[free] = problem.R[: len(free)], problem.t[: len(free)]
        atlas.points.pos[ids] = problem.X
        drop_outliers(atlas.points, kf, ids, slots, problem.start, problem.pose, problem.use)

    def turn(self, R: F64) -> None:
        """Turn the whole map about its origin: ``R`` (3, 3) takes old map points to new ones."""
        points, kf = self.atlas.points, self.atlas.keyframes
        points.pos[:] = points.pos @ R.T
        points.normal[:] = points.normal @ R.T
        kf.R[:] = kf.R @ R.T

    def _cull_keyframes(self, k: int) -> None:
        atlas = self.atlas
        kf = atlas.keyframes
        for other in neighbours(atlas, k, 15, 30):
            if kf.serial[other] == 0 or kf.serial[other] >= atlas.newest_serial - 1:
                continue
            if redundancy(atlas.points, kf, int(other)) > 0.9:
                self.retire(int(other))

    def retire(self, k: int) -> None:
        """Take a keyframe out of the map, remembering where it stood relative to its nearest relative."""
        atlas = self.atlas
        kf = atlas.keyframes
        standin = neighbours(atlas, k, 1, 1)
        if not len(standin):
            return
        s = int(standin[0])
        relative = pose(kf.R[s], kf.t[s]) @ inverse(pose(kf.R[k], kf.t[k]))
        self.retired[int(kf.serial[k])] = (int(kf.serial[s]), relative)
        remove_keyframe(atlas.points, kf, k)

    def keyframe_pose(self, serial: int) -> F64:
        """Return T_map_keyframe (4, 4) of a keyframe that lives, or lived.

        Raises:
            KeyError: for a serial that never was.
        """
        relative = np.eye(4)
        while serial in self.retired:
            serial, step = self.retired[serial]
            relative = step @ relative
        k = self.atlas.slot_of(serial)
        if k < 0:
            raise KeyError(f"no keyframe {serial}")
        return inverse(pose(self.atlas.keyframes.R[k], self.atlas.keyframes.t[k])) @ relative


@njit(cache=True, nogil=True)
def cull_recent(points: Points, kf: Keyframes, recent: I32, now: int) -> I32:
    """Remove young points that prove bad: seldom found where they should be, or seen by one keyframe only.

    ``recent`` (M, 2) point, serial of birth; returns those that are still on probation.
    """
    out = np.empty_like(recent)
    count = 0
    for row in range(len(recent)):
        p, born = recent[row, 0], recent[row, 1]
        if points.n[p] == 0 or points.born[p] != born:
            continue
        if 4 * points.found[p] < points.visible[p] or (now - born >= 3 and points.n[p] < 2):
            remove_point(points, kf, p)
        elif now - born < 3:
            out[count] = recent[row]
            count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def describe_all(points: Points, kf: Keyframes, k: int, scales: F64) -> None:
    """Renew the description of all points that keyframe ``k`` sees."""
    for i in range(kf.n[k]):
        if kf.point[k, i] >= 0:
            describe(points, kf, kf.point[k, i], scales)


@njit(cache=True, nogil=True)
def fuse(
    points: Points, kf: Keyframes, k: int, ids: I32, camera: F64, variance: F64, scales: F64,
    cols: int, width: float, height: float,
) -> int:  # fmt: skip
    """Find points ``ids`` among the features of keyframe ``k``: new observations, or two points made one.

    Returns how many were joined. Only matches within the chi-square limit of the projection count.
    """
    candidates = np.empty(len(ids), np.int32)
    m = 0
    for p in ids:
        seen = points.n[p] == 0
        for j in range(points.n[p]):
            seen = seen or points.frame[p, j] == k
        if not seen:
            candidates[m] = p
            m += 1
    candidates = candidates[:m]
    place, octave, cosine = np.empty((m, 3)), np.zeros(m, np.int32), np.empty(m)
    project(candidates, points.pos, points.normal, points.near, points.far, kf.R[k], kf.t[k], camera, width, height,
            scales[1] / scales[0], len(scales), place, octave, cosine)  # fmt: skip
    n = kf.n[k]
    uv, disparity = kf.uv[k, :n].astype(np.float64), kf.disparity[k, :n].astype(np.float64)
    radius = 3.0 * scales[octave]
    match = match_windows(
        place, radius, octave - 1, octave + 1, points.desc[candidates], uv, disparity, kf.octave[k, :n].copy(),
        kf.desc[k, :n].copy(), kf.cell_start[k].copy(), kf.cell_items[k].copy(), cols, np.ones(n, np.bool_), MATCH_STRICT, 1.0,
    )  # fmt: skip
    joined = 0
    for c in range(m):
        i = match[c]
        if i < 0:
            continue
        e = ((uv[i, 0] - place[c, 0]) ** 2 + (uv[i, 1] - place[c, 1]) ** 2) / variance[kf.octave[k, i]]
        limit = CHI2_MONO
        if disparity[i] > 0.0:
            e += (disparity[i] - place[c, 2]) ** 2 * kf.info[k, i]
            limit = CHI2_DEPTH
        if e > limit:
            continue
        p, q = candidates[c], kf.point[k, i]
        if points.n[p] == 0:
            continue
        joined += 1
        if q < 0:
            observe(points, kf, p, k, i)
        elif points.n[q] >= points.n[p]:
            merge(points, kf, q, p, scales)
        else:
            merge(points, kf, p, q, scales)
    return joined


@njit(cache=True, nogil=True)
def drop_outliers(
    points: Points, kf: Keyframes, ids: I32, slots: I32, start: I32, frame: I32, use: NDArray[np.bool_]
) -> None:
    """Forget the observations of an adjustment that ended as outliers."""
    for m in range(len(ids)):
        for o in range(start[m], start[m + 1]):
            if not use[o]:
                forget(points, kf, ids[m], slots[frame[o]])


@njit(cache=True, nogil=True)
def redundancy(points: Points, kf: Keyframes, k: int) -> float:
    """Return the share of a keyframe's points that three others see at the same or a finer scale."""
    total, redundant = 0, 0
    for i in range(kf.n[k]):
        p = kf.point[k, i]
        if p < 0:
            continue
        total += 1
        others = 0
        for j in range(points.n[p]):
            other = points.frame[p, j]
            if other != k and kf.octave[other, points.feature[p, j]] <= kf.octave[k, i] + 1:
                others += 1
        redundant += others >= 3
    return redundant / max(total, 1)
