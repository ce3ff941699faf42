"""The map's arrays, points and keyframes in slots, and the compiled operations that keep them consistent.

Invariant: ``keyframes.point[k, i] == p`` if and only if the pair (k, i) stands once among the first ``points.n[p]``
entries of ``points.frame[p]`` and ``points.feature[p]``; only living points and keyframes take part.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.slam.binary import hamming

F64 = NDArray[np.float64]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]

MAX_OBSERVATIONS = 48
"""Keyframes that one point remembers; the oldest but one is forgotten for a newer one."""


class Points(NamedTuple):
    """Map points (P first)."""

    pos: F64
    normal: F64
    """Mean direction from the keyframes to the point, unit."""
    near: F64
    far: F64
    """Distances between which its octaves can see it."""
    desc: NDArray[np.uint64]
    frame: I16
    """(P, MAX_OBSERVATIONS) keyframe slots; most points are seen by a few: two bytes each, for there are many."""
    feature: I16
    n: I32
    """(P,) observations; 0 is a free slot."""
    found: I32
    visible: I32
    born: I32
    """(P,) serial of the keyframe that made it."""
    parallax: F64
    """(P,) of a point begun far away: sum over its keyframes of (sideways distance from the first / octave's scale)
    squared; -1 for a point with measured depth."""


class Keyframes(NamedTuple):
    """Keyframes (K first) with their features (N second)."""

    R: F64
    """(K, 3, 3) camera from map."""
    t: F64
    uv: NDArray[np.float32]
    depth: NDArray[np.float32]
    disparity: NDArray[np.float32]
    far: NDArray[np.bool_]
    """Beyond the sensor's range."""
    info: NDArray[np.float32]
    """Inverse variance of the disparity."""
    octave: NDArray[np.int32]
    angle: NDArray[np.float32]
    desc: NDArray[np.uint64]
    point: I32
    """(K, N) map point of each feature, -1 = none."""
    n: I32
    """(K,) features; 0 is a free slot."""
    serial: I32
    """(K,) number of the keyframe, never used twice."""
    cell_start: I32
    cell_items: I32


@njit(cache=True, nogil=True)
def observe(points: Points, kf: Keyframes, p: int, k: int, i: int) -> bool:
    """Record that keyframe ``k`` sees point ``p`` at feature ``i``; False when either is taken already."""
    if kf.point[k, i] >= 0:
        return False
    n = points.n[p]
    for j in range(n):
        if points.frame[p, j] == k:
            return False
    if n == points.frame.shape[1]:
        kf.point[points.frame[p, 1], points.feature[p, 1]] = -1
        for j in range(2, n):
            points.frame[p, j - 1], points.feature[p, j - 1] = points.frame[p, j], points.feature[p, j]
        n -= 1
    points.frame[p, n], points.feature[p, n] = k, i
    points.n[p] = n + 1
    kf.point[k, i] = p
    return True


@njit(cache=True, nogil=True)
def observe_all(points: Points, kf: Keyframes, k: int, point: I32) -> None:
    """Record all observations of a keyframe: ``point`` (n,) per feature, -1 = none, dead points are passed over."""
    for i in range(len(point)):
        if point[i] >= 0 and points.n[point[i]] > 0:
            observe(points, kf, point[i], k, i)


@njit(cache=True, nogil=True)
def forget(points: Points, kf: Keyframes, p: int, k: int) -> None:
    """Remove keyframe ``k``'s observation of ``p``; a point that nobody sees is gone."""
    n = points.n[p]
    for j in range(n):
        if points.frame[p, j] == k:
            kf.point[k, points.feature[p, j]] = -1
            for m in range(j + 1, n):
                points.frame[p, m - 1], points.feature[p, m - 1] = points.frame[p, m], points.feature[p, m]
            points.n[p] = n - 1
            return


@njit(cache=True, nogil=True)
def remove_point(points: Points, kf: Keyframes, p: int) -> None:
    """Remove a point and its observations."""
    for j in range(points.n[p]):
        kf.point[points.frame[p, j], points.feature[p, j]] = -1
    points.n[p] = 0


@njit(cache=True, nogil=True)
def remove_keyframe(points: Points, kf: Keyframes, k: int) -> None:
    """Remove a keyframe and its observations."""
    for i in range(kf.n[k]):
        p = kf.point[k, i]
        if p >= 0:
            forget(points, kf, p, k)
    kf.n[k] = 0


@njit(cache=True, nogil=True)
def merge(points: Points, kf: Keyframes, keep: int, drop: int, scales: F64) -> None:
    """Make two points one: ``keep`` takes over ``drop``'s observations where its own keyframes do not clash."""
    n = points.n[drop]
    frames, features = points.frame[drop, :n].copy(), points.feature[drop, :n].copy()
    found, visible = points.found[drop], points.visible[drop]
    remove_point(points, kf, drop)
    for j in range(n):
        observe(points, kf, keep, int(frames[j]), int(features[j]))
    points.found[keep] += found
    points.visible[keep] += visible
    describe(points, kf, keep, scales)


@njit(cache=True, nogil=True)
def describe(points: Points, kf: Keyframes, p: int, scales: F64) -> None:
    """Renew a point's descriptor (the one nearest to all others), mean direction and range of distances."""
    n = points.n[p]
    if n == 0:
        return
    best, best_sum = 0, 1 << 30
    sx = sy = sz = 0.0
    for a in range(n):
        k = points.frame[p, a]
        total = 0
        for b in range(n):
            total += hamming(kf.desc[k, points.feature[p, a]], kf.desc[points.frame[p, b], points.feature[p, b]])
        if total < best_sum:
            best, best_sum = a, total
        dx, dy, dz, d = direction(points, kf, p, k)
        sx, sy, sz = sx + dx / d, sy + dy / d, sz + dz / d
    k, i = points.frame[p, best], points.feature[p, best]
    for w in range(4):
        points.desc[p, w] = kf.desc[k, i, w]
    norm = max(math.sqrt(sx * sx + sy * sy + sz * sz), 1e-12)
    points.normal[p, 0], points.normal[p, 1], points.normal[p, 2] = sx / norm, sy / norm, sz / norm
    k, i = points.frame[p, 0], points.feature[p, 0]
    _, _, _, d = direction(points, kf, p, k)
    points.far[p] = d * scales[kf.octave[k, i]]
    points.near[p] = points.far[p] / scales[len(scales) - 1]
    points.parallax[p] = parallax(points, kf, p, scales) if kf.far[k, i] else -1.0


@njit(cache=True, nogil=True)
def parallax(points: Points, kf: Keyframes, p: int, scales: F64) -> float:
    """Return ``Points.parallax`` of a point: what its keyframes know of its distance, but for the focal length."""
    ax, ay, az, a = direction(points, kf, p, points.frame[p, 0])
    total = 0.0
    for j in range(1, points.n[p]):
        k = points.frame[p, j]
        bx, by, bz, _ = direction(points, kf, p, k)
        x, y, z = ax - bx, ay - by, az - bz
        along = (x * ax + y * ay + z * az) / a
        sideways2 = max(x * x + y * y + z * z - along * along, 0.0)
        total += sideways2 / scales[kf.octave[k, points.feature[p, j]]] ** 2
    return total


@njit(cache=True, nogil=True)
def direction(points: Points, kf: Keyframes, p: int, k: int) -> tuple[float, float, float, float]:
    """Return the vector from keyframe ``k``'s centre to point ``p``, map frame, and its length."""
    R, t = kf.R[k], kf.t[k]
    dx = points.pos[p, 0] + R[0, 0] * t[0] + R[1, 0] * t[1] + R[2, 0] * t[2]
    dy = points.pos[p, 1] + R[0, 1] * t[0] + R[1, 1] * t[1] + R[2, 1] * t[2]
    dz = points.pos[p, 2] + R[0, 2] * t[0] + R[1, 2] * t[1] + R[2, 2] * t[2]
    return dx, dy, dz, max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-9)


@njit(cache=True, nogil=True)
def create_points(
    points: Points, kf: Keyframes, k: int, slots: I32, camera: F64, low_m: float, high_m: float, far_m: float,
    scales: F64,
) -> int:  # fmt: skip
    """Make a point of each feature of ``k`` without one that has depth in range, or is far; return how many."""
    made = 0
    R, t = kf.R[k], kf.t[k]
    for i in range(kf.n[k]):
        z = kf.depth[k, i]
        if kf.far[k, i]:
            z = far_m
        elif z < low_m or z > high_m:
            continue
        if kf.point[k, i] >= 0:
            continue
        if made == len(slots):
            break
        p = slots[made]
        x = (kf.uv[k, i, 0] - camera[2]) * z / camera[0] - t[0]
        y = (kf.uv[k, i, 1] - camera[3]) * z / camera[1] - t[1]
        w = z - t[2]
        for c in range(3):
            points.pos[p, c] = R[0, c] * x + R[1, c] * y + R[2, c] * w
        points.n[p], points.found[p], points.visible[p] = 0, 1, 1
        points.born[p] = kf.serial[k]
        observe(points, kf, p, k, i)
        describe(points, kf, p, scales)
        made += 1
    return made


@njit(cache=True, nogil=True)
def shared_counts(points: Points, ids: I32, keyframes: int) -> I32:
    """Return for each keyframe slot (K,) how many of the points ``ids`` (-1: passed over) it sees."""
    counts = np.zeros(keyframes, np.int32)
    for p in ids:
        if p >= 0:
            for j in range(points.n[p]):
                counts[points.frame[p, j]] += 1
    return counts


@njit(cache=True, nogil=True)
def points_of(points: Points, kf: Keyframes, slots: I32) -> I32:
    """Return the points that keyframes ``slots`` see, each once, in order of first sight."""
    mark = np.zeros(len(points.n), np.bool_)
    out = np.empty(len(points.n), np.int32)
    count = 0
    for k in slots:
        for i in range(kf.n[k]):
            p = kf.point[k, i]
            if p >= 0 and not mark[p]:
                mark[p] = True
                out[count] = p
                count += 1
    return out[:count].copy()
