"""The front end: where is the camera in this frame, given the last frame and the map around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.atlas import Atlas, neighbours
from services.slam.binary import match_all
from services.slam.blind import LEAST, ransac
from services.slam.camera import CameraModel
from services.slam.config import SlamConfig
from services.slam.far import FarPrior
from services.slam.features import Features
from services.slam.linear import log_so3, matmul3
from services.slam.links import Keyframes, Points, points_of, shared_counts
from services.slam.match import keep_common_turn, match_windows, project
from services.slam.refine import refine_pose

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]

MATCH_LOOSE = 100
"""Hamming distance allowed where the place is known well."""
MATCH_BLIND = 60
"""Where it is not."""
_WINDOW_LAST_PX = 15.0
_WINDOW_MAP_PX = 5.0
_WINDOW_UNSURE_PX = 15.0
_SMEAR_VARIANCE = 9.0
"""Times the usual variance of u and v in a smeared image."""
_PROVEN, _PROVEN_LEAST = 5, 40
"""Frames in which a point has been found, from which on it is proven; and so many such points place a frame."""
_ENOUGH = 20
"""Matches with the last frame below which the window is widened."""


@dataclass(slots=True)
class Tracked:
    """A frame with its pose and the map points it sees."""

    features: Features
    R: F64
    """Camera from map."""
    t: F64
    point: I32
    """(N,) map point of each feature, -1 = none."""
    inliers: int = 0
    information: F64 | None = None
    """(6, 6) of the pose, order (v, w), left perturbation of camera from map."""
    chi2: float = 0.0
    place: F64 | None = None
    """(M, 3) u, v, disparity of the local map's points with measured depth that should be seen besides those matched before."""
    expected: int = 0
    """Points of the local map that should be seen, with those that are."""


class Tracking:
    """Finds poses; reads the map, writes only the points' found and visible counters."""

    def __init__(self, atlas: Atlas, camera: CameraModel, config: SlamConfig, far: FarPrior) -> None:
        self.atlas = atlas
        self.camera = camera
        self.config = config
        self.far = far

    def follow(self, last: Tracked, features: Features, R: F64, t: F64) -> Tracked | None:
        """Return the frame located from the last one, started at the predicted ``R``, ``t``; None when that fails."""
        world, known, usable = self._points_of_last(last)
        usable &= last.features.moving_s == 0.0
        for widen in (1.0, 2.0, 4.0):
            match = self._match_last(last, features, R, t, world, usable, widen * _WINDOW_LAST_PX)
            if np.count_nonzero(match >= 0) < _ENOUGH * widen:
                continue
            found = self._locate(features, R, t, world, match, known, last)
            if found is not None and found.inliers >= 0.5 * _ENOUGH:
                return found
        return self._follow_blind(last, features, world, known, usable)

    def _points_of_last(self, last: Tracked) -> tuple[F64, I32, Bool]:
        """Return places (N, 3) in the map of the last frame's features, their map points (-1: temporary), and which."""
        known = np.where(last.point >= 0, last.point, -1)
        known[(known >= 0) & (self.atlas.points.n[known] == 0)] = -1
        f, cam = last.features, self.camera.array
        z = np.where(f.far, self.far.distance_m, f.depth)
        local = np.stack([(f.uv[:, 0] - cam[2]) * z / cam[0], (f.uv[:, 1] - cam[3]) * z / cam[1], z], axis=1)
        world = (local - last.t) @ last.R
        has = known >= 0
        world[has] = self.atlas.points.pos[known[has]]
        return world, known, has | ((z > 0.0) & (not f.smeared))

    def by_proven(self, frame: Tracked) -> Tracked | None:
        """Return the frame as only points place it that were found in several frames before; None where they are too few."""
        p = self.atlas.points
        index = np.flatnonzero(frame.point >= 0)
        index = index[p.found[frame.point[index]] >= _PROVEN]
        if len(index) < _PROVEN_LEAST:
            return None
        ids, R, t = frame.point[index], frame.R.copy(), frame.t.copy()
        doubt = far_doubt(p, self.atlas.keyframes, ids, R, t, self.camera.focal, self.far.sigma_inverse_m)
        count, _, H, chi2 = self.refine(frame.features, R, t, p.pos[ids], index, doubt)
        return Tracked(frame.features, R, t, frame.point, count, H, chi2) if count >= _PROVEN_LEAST else None

    def off_their_places(self, last: Tracked, frame: Tracked) -> tuple[I32, F64]:
        """Return which feature of the frame each of the last one's became (-1: not seen), and how far off it is.

        The second (N, 2) is of the frame's features: pixels from where the camera's motion takes what was seen in the last
        frame, NaN where nothing known was.
        """
        f, cam = frame.features, self.camera
        world, _, usable = self._points_of_last(last)
        match = self._match_last(last, f, frame.R, frame.t, world, usable, 2.0 * _WINDOW_LAST_PX)
        queries = np.flatnonzero(match >= 0)
        place = predict(world[queries], usable[queries], frame.R, frame.t, cam.array, cam.width, cam.height)
        off = np.full((len(f), 2), np.nan)
        off[match[queries]] = f.uv[match[queries]] - place[:, :2]
        return match, off

    def _doubt_of_last(self, known: I32, features: I32, last: Tracked | None, R: F64, t: F64) -> F64:
        """Return the doubt (M,) of the last frame's ``features``: of map points ``known``, or (-1) temporary ones."""
        atlas, focal, sigma = self.atlas, self.camera.focal, self.far.sigma_inverse_m
        doubt = far_doubt(atlas.points, atlas.keyframes, known, R, t, focal, sigma)
        if last is not None:
            step_m = moved(R, t, last.R, last.t)[0]
            doubt[(known < 0) & last.features.far[features]] = (focal * step_m * sigma) ** 2
        return doubt

    def _match_last(
        self, last: Tracked, features: Features, R: F64, t: F64, world: F64, usable: Bool, window_px: float
    ) -> I32:
        cam, f = self.camera, last.features
        place = predict(world, usable, R, t, cam.array, cam.width, cam.height)
        radius = window_px * cam.scales[f.octave]
        match = match_windows(
            place, radius, f.octave - 1, f.octave + 1, f.desc, features.uv, features.disparity, features.octave,
            features.desc, features.cell_start, features.cell_items, cam.cols, np.ones(len(features), np.bool_),
            MATCH_LOOSE, 0.9,
        )  # fmt: skip
        keep_common_turn(match, f.angle, features.angle)
        return match

    def _locate(
        self, features: Features, R: F64, t: F64, world: F64, match: I32, known: I32, last: Tracked | None
    ) -> Tracked | None:
        """Refine a pose over matches (query -> feature); the result holds the inliers that are map points."""
        queries = np.flatnonzero(match >= 0)
        index = match[queries]
        R, t = R.copy(), t.copy()
        doubt = self._doubt_of_last(known[queries], queries.astype(np.int32), last, R, t)
        count, use, H, chi2 = self.refine(features, R, t, world[queries], index, doubt)
        if count < 6:
            return None
        point = np.full(len(features), -1, np.int32)
        good = use & (known[queries] >= 0)
        point[index[good]] = known[queries[good]]
        return Tracked(features, R, t, point, count, H, chi2)

    def refine(
        self, features: Features, R: F64, t: F64, world: F64, index: NDArray, doubt: F64
    ) -> tuple[int, Bool, F64, float]:
        """Refine ``R``, ``t`` in place from ``world`` (M, 3) seen at features ``index``: inliers, which, information, chi2.

        ``doubt`` (M,) is the variance, pixels squared, that a point's unknown distance adds to where it is seen.
        """
        cam = self.camera
        disparity = features.disparity[index]
        obs = np.column_stack([features.uv[index], disparity])
        variance = cam.variance[features.octave[index]] * (_SMEAR_VARIANCE if features.smeared else 1.0)
        info = np.column_stack([1.0 / (variance + doubt), features.info[index]])
        use, H = np.ones(len(index), np.bool_), np.zeros((6, 6))
        if len(index) < 6:
            return 0, use, H, 0.0
        count, chi2 = refine_pose(R, t, np.ascontiguousarray(world), obs, info, cam.array, use, H, 4)
        return count, use, H, chi2

    def _follow_blind(self, last: Tracked, features: Features, world: F64, known: I32, usable: Bool) -> Tracked | None:
        """Search widely: descriptors alone, then RANSAC."""
        queries = np.flatnonzero(usable)
        if not len(queries) or not len(features):
            return None
        part = match_all(last.features.desc[queries], features.desc, MATCH_BLIND, 0.85)
        match = np.full(len(world), -1, np.int32)
        match[queries] = part
        keep_common_turn(match, last.features.angle, features.angle)
        return self.locate_by_ransac(features, world, match, known, last)

    def locate_by_ransac(
        self, features: Features, world: F64, match: I32, known: I32, last: Tracked | None = None
    ) -> Tracked | None:
        """Locate a frame without any prior from 3D-2D matches (query -> feature): AP3P in RANSAC, then refinement."""
        queries = np.flatnonzero(match >= 0)
        measured = queries[self._measured(known, last)[queries]]
        chosen = measured if len(measured) >= LEAST else queries  # far ones only where there are too few others
        found = ransac(world[chosen], features.uv[match[chosen]], self.camera.array)
        if found is None:
            return None
        R, t, agree = found
        kept = np.full_like(match, -1)
        kept[chosen[agree]] = match[chosen[agree]]
        return self._locate(features, R, t, world, kept, known, last)

    def _measured(self, known: I32, last: Tracked | None) -> Bool:
        """Return which of map points ``known``, or (-1) temporary ones of the ``last`` frame, have measured depth."""
        measured = self.atlas.points.parallax[known] < 0.0
        return np.where(known < 0, last is None or ~last.features.far, measured)

    def again(self, frame: Tracked) -> None:
        """Refine a frame's pose by the points it sees, in place, after its features were moved."""
        index = np.flatnonzero(frame.point >= 0)
        ids, p = frame.point[index], self.atlas.points
        R, t = frame.R.copy(), frame.t.copy()
        doubt = far_doubt(p, self.atlas.keyframes, ids, R, t, self.camera.array[0], self.far.sigma_inverse_m)
        count, use, H, chi2 = self.refine(frame.features, R, t, p.pos[ids], index, doubt)
        if count < 6:
            return
        frame.R, frame.t, frame.information, frame.chi2 = R, t, H, chi2
        frame.inliers = count
        frame.point[index[~use]] = -1

    def join_map(self, frame: Tracked, *, unsure: bool = False) -> tuple[Tracked, int] | None:
        """Match the frame with the local map and refine; returns it and its best keyframe slot, None when that fails.

        ``unsure``: the pose it was found at may be some centimetres off, so the map is first searched in wider windows.
        """
        atlas = self.atlas
        counts = shared_counts(atlas.points, frame.point, len(atlas.keyframes.n))
        if not counts.any():
            return None
        around = self._local_keyframes(counts)
        if unsure:
            frame = self.join_keyframes(frame, around, _WINDOW_UNSURE_PX) or frame
        located = self.join_keyframes(frame, around, _WINDOW_MAP_PX, tally=True)
        if located is None:
            return None
        counts = shared_counts(atlas.points, located.point, len(atlas.keyframes.n))
        return located, int(np.lexsort((-atlas.keyframes.serial, -counts))[0])

    def join_keyframes(self, frame: Tracked, slots: I32, window_px: float, *, tally: bool = False) -> Tracked | None:
        """Match the frame with the points that keyframes ``slots`` see and refine; ``tally`` keeps the points' counters."""
        f, cam, p = frame.features, self.camera, self.atlas.points
        ids = points_of(p, self.atlas.keyframes, slots)
        taken = np.zeros(len(p.n), np.bool_)
        taken[frame.point[frame.point >= 0]] = True
        ids = ids[~taken[ids]]
        m = len(ids)
        place, octave, cosine = np.empty((m, 3)), np.zeros(m, np.int32), np.empty(m)
        project(ids, p.pos, p.normal, p.near, p.far, frame.R, frame.t, cam.array, cam.width, cam.height,
                self.config.scale, self.config.levels, place, octave, cosine)  # fmt: skip
        match = match_windows(
            place, window_px * cam.scales[octave], octave - 1, octave + 1, p.desc[ids], f.uv, f.disparity, f.octave, f.desc,
            f.cell_start, f.cell_items, cam.cols, frame.point < 0, MATCH_LOOSE, 0.8,
        )  # fmt: skip
        point = frame.point.copy()
        got = match >= 0
        point[match[got]] = ids[got]
        index = np.flatnonzero(point >= 0)
        R, t = frame.R.copy(), frame.t.copy()
        doubt = far_doubt(p, self.atlas.keyframes, point[index], R, t, cam.focal, self.far.sigma_inverse_m)
        count, use, H, chi2 = self.refine(f, R, t, p.pos[point[index]], index, doubt)
        if tally:
            p.visible[ids[~np.isnan(place[:, 0])]] += 1
            p.visible[frame.point[frame.point >= 0]] += 1
            p.found[point[index[use]]] += 1
        if count < 6:
            return None
        point[index[~use]] = -1
        seen = ~np.isnan(place[:, 0])
        expected = int(np.count_nonzero(seen)) + int(np.count_nonzero(frame.point >= 0))
        return Tracked(f, R, t, point, count, H, chi2, place[seen & (p.parallax[ids] < 0.0)], expected)

    def _local_keyframes(self, counts: I32) -> I32:
        atlas = self.atlas
        order = np.lexsort((-atlas.keyframes.serial, -counts))
        first = order[counts[order] > 0][:30]
        chosen = list(first)
        for k in first[:4]:
            chosen.extend(neighbours(atlas, int(k), 30, 5))
        return np.array(list(dict.fromkeys(int(k) for k in chosen)), np.int32)


@njit(cache=True, nogil=True)
def far_doubt(points: Points, kf: Keyframes, ids: I32, R: F64, t: F64, focal: float, sigma: float) -> F64:
    """Return the variance (M,), pixels squared, of where points are seen from ``R``, ``t`` for want of their distance.

    A distance known to ``s`` (inverse metres) only shifts the image by ``focal * s`` per metre away from the keyframe that
    first saw the point. Zero for points with measured depth and for -1.
    """
    out = np.zeros(len(ids))
    for i in range(len(ids)):
        p = ids[i]
        if p < 0 or points.parallax[p] < 0.0:
            continue
        k = points.frame[p, 0]
        step2 = 0.0
        for c in range(3):
            a = kf.R[k, 0, c] * kf.t[k, 0] + kf.R[k, 1, c] * kf.t[k, 1] + kf.R[k, 2, c] * kf.t[k, 2]
            b = R[0, c] * t[0] + R[1, c] * t[1] + R[2, c] * t[2]
            step2 += (a - b) ** 2
        out[i] = focal**2 * step2 / (1.0 / sigma**2 + focal**2 * points.parallax[p])
    return out


@njit(cache=True, nogil=True)
def predict(world: F64, usable: Bool, R: F64, t: F64, camera: F64, width: float, height: float) -> F64:
    """Return (M, 3) u, v, disparity of points seen from ``R``, ``t``; u is NaN where unusable or out of sight."""
    out = np.full((len(world), 3), np.nan)
    for i in range(len(world)):
        if not usable[i]:
            continue
        X = world[i]
        z = R[2, 0] * X[0] + R[2, 1] * X[1] + R[2, 2] * X[2] + t[2]
        if z < 0.05:
            continue
        u = camera[0] * (R[0, 0] * X[0] + R[0, 1] * X[1] + R[0, 2] * X[2] + t[0]) / z + camera[2]
        v = camera[1] * (R[1, 0] * X[0] + R[1, 1] * X[1] + R[1, 2] * X[2] + t[1]) / z + camera[3]
        if 0.0 <= u < width and 0.0 <= v < height:
            out[i, 0], out[i, 1], out[i, 2] = u, v, camera[4] / z
    return out


def still_points(points: Points, point: I32) -> I32:
    """Return ``point`` with those that left the map replaced by -1."""
    out = point.copy()
    has = out >= 0
    out[has] = np.where(points.n[out[has]] > 0, out[has], -1)
    return out


def moved(R_a: F64, t_a: F64, R_b: F64, t_b: F64) -> tuple[float, float]:
    """Return the distance (m) and angle (rad) between two camera-from-map poses."""
    distance = float(np.linalg.norm(R_a.T @ t_a - R_b.T @ t_b))
    return distance, float(np.linalg.norm(log_so3(matmul3(R_a, np.ascontiguousarray(R_b.T)))))
