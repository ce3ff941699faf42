"""The reference's own method, as a baseline: plane, pair projection, clusters, hull circles, stacked.

Chapter 3 of "Tree Position Detection for Autonomous UAV Navigation": RANSAC ground plane, whose normal is "up";
density (eq. 12) and slice thickness ``4 rho`` (eq. 13); each lower point paired with its nearest upper one and cut with
the slice's plane; Euclidean clustering at 5 cm; Graham's convex hull; a circle by Levenberg-Marquardt on the hull's
points; circles of 3..20 cm stacked from near the ground. Free choices, tuned fairly on whole rings: planes every
0.10 m, and a cluster floor scaled down to what a slice of a thin trunk then holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import rotation_aligning
from services.detector.model import DetectionResult, Floats, Ground, Trunk

LEAF_M = 0.01
PLANE_M = 0.08
"""Points this near to the plane are ground."""
SPACING_M = 0.10
LIMIT_M = 2.2
CLUSTER_M = 0.05
CLUSTER_SIZE = (10, 4000)
RADIUS_M = (0.03, 0.20)
MIN_LAYERS = 6
SAME_PLACE_M = 0.06
SAME_RADIUS_M = 0.03
START_M = 0.8
"""A stack begins below this height."""
_ERROR_SHARE = 0.25
"""A hull whose points stray from the circle by more than this share of the radius is none."""


@dataclass(frozen=True, slots=True)
class HullCircle:
    """A circle in one slice, upright frame."""

    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    points: int


def voxel_centroids(points_m: Floats, leaf_m: float) -> Floats:
    """Return the centroid of each occupied voxel (N, 3)."""
    keys = np.floor(points_m / leaf_m).astype(np.int64)
    _, index, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(index.ravel(), weights=points_m[:, c]) for c in range(3)], axis=1)
    return np.asarray(sums / count[:, None])


def ground_plane(points_m: Floats, up: Floats, trials: int = 300) -> tuple[Floats, float]:
    """Return (unit normal, offset) of the plane with most points among those within 35 degrees of level (RANSAC)."""
    rng = np.random.default_rng(1)
    height = points_m @ up
    low = points_m[height <= np.percentile(height, 60.0)]  # on a flat cloud all of them
    sample = low[:: max(1, len(low) // 20_000)]
    best, best_on = (up, float(np.percentile(height, 2.0))), 0
    for _ in range(trials):
        a, b, c = sample[rng.integers(0, len(sample), 3)]
        n = np.cross(b - a, c - a)
        length = float(np.linalg.norm(n))
        if length < 1e-9 or abs(n @ up) < 0.82 * length:
            continue
        n = n / length * np.sign(n @ up)
        on = int(np.count_nonzero(np.abs(sample @ n - a @ n) < 0.5 * PLANE_M))
        if on > best_on:
            best, best_on = (n, float(a @ n)), on
    return best


def density_m(points_m: Floats, n: int = 1000, m: int = 1) -> float:
    """Return rho (eq. 12): mean over ``n`` random points of the mean distance to their ``m`` nearest neighbours."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(1)
    chosen = points_m[rng.integers(0, len(points_m), n)]
    distance, _ = cKDTree(points_m).query(chosen, k=m + 1)
    return float(np.mean(distance[:, 1:]))


def project_pairs(points_m: Floats, z_m: float, thickness_m: float) -> Floats:
    """Return (K, 2): where segments from each point just below the plane to its nearest just above cut it."""
    from scipy.spatial import cKDTree

    z = points_m[:, 2] - z_m
    lower, upper = points_m[(z <= 0) & (z > -0.5 * thickness_m)], points_m[(z > 0) & (z < 0.5 * thickness_m)]
    if len(lower) == 0 or len(upper) == 0:
        return np.zeros((0, 2))
    distance, index = cKDTree(upper).query(lower, distance_upper_bound=thickness_m)
    good = np.isfinite(distance)
    a, b = lower[good], upper[index[good]]
    share = (z_m - a[:, 2]) / np.maximum(b[:, 2] - a[:, 2], 1e-12)
    return np.asarray(a[:, :2] + share[:, None] * (b[:, :2] - a[:, :2]))


def euclidean_clusters(points_m: Floats, distance_m: float) -> list[NDArray[np.intp]]:
    """Return the index sets of points (any dimension) linked by steps of at most ``distance_m``."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if len(points_m) == 0:
        return []
    pairs = cKDTree(points_m).query_pairs(distance_m, output_type="ndarray")
    n = len(points_m)
    graph = coo_matrix((np.ones(len(pairs), dtype=np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return [order[a:b] for a, b in zip(*_bounds(label[order], count), strict=True)]


def _bounds(label: NDArray[np.int32], count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    return np.searchsorted(label, np.arange(count)), np.searchsorted(label, np.arange(count), side="right")


def graham_hull(points_m: Floats) -> Floats:
    """Return the corners of the convex hull of (N, 2), counter-clockwise (Graham 1972)."""
    start = np.lexsort((points_m[:, 0], points_m[:, 1]))[0]
    d = points_m - points_m[start]
    order = np.lexsort((np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])))
    hull: list[Floats] = [points_m[start]]
    for k in order:
        if k == start:
            continue
        p = points_m[k]
        while len(hull) > 1 and _turn(hull[-2], hull[-1], p) <= 0.0:
            hull.pop()
        hull.append(p)
    return np.array(hull)


def _turn(a: Floats, b: Floats, c: Floats) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def circle_lm(points_m: Floats) -> tuple[float, float, float, float]:
    """Return (x, y, radius, rms) of the geometric circle through (N, 2), Levenberg-Marquardt (Chernov)."""
    x = np.array([*points_m.mean(axis=0), 0.0])
    x[2] = float(np.hypot(*(points_m - x[:2]).T).mean())
    damping, last = 1e-3, np.inf
    for _ in range(50):
        d = points_m - x[:2]
        rho = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-12)
        e = rho - x[2]
        J = np.column_stack([-d[:, 0] / rho, -d[:, 1] / rho, -np.ones(len(d))])
        cost = float(e @ e)
        A = J.T @ J
        step = np.linalg.solve(A + np.diag(damping * np.diag(A) + 1e-9), -J.T @ e)
        new = x + step
        moved = points_m - new[:2]
        trial = float(((np.hypot(moved[:, 0], moved[:, 1]) - new[2]) ** 2).sum())
        if trial < cost:
            x, damping = new, damping / 3.0
            if last - trial < 1e-14:
                break
            last = trial
        else:
            damping *= 5.0
            if damping > 1e9:
                break
    e = np.hypot(*(points_m - x[:2]).T) - x[2]
    return float(x[0]), float(x[1]), float(x[2]), float(np.sqrt(np.mean(e**2)))


def slice_circles(points_m: Floats, z_m: float, thickness_m: float, cluster_m: float = CLUSTER_M) -> list[HullCircle]:
    """Return the circles of one slice plane."""
    flat = project_pairs(points_m, z_m, thickness_m)
    circles = []
    for members in euclidean_clusters(flat, cluster_m):
        if not CLUSTER_SIZE[0] <= len(members) <= CLUSTER_SIZE[1]:
            continue
        hull = graham_hull(flat[members])
        if len(hull) < 4:
            continue
        x, y, r, rms = circle_lm(hull)
        if RADIUS_M[0] <= r <= RADIUS_M[1] and rms < _ERROR_SHARE * r:
            circles.append(HullCircle(x, y, z_m, r, len(members)))
    return circles


def stack(slices: list[list[HullCircle]]) -> list[list[HullCircle]]:
    """Return stacks of like circles over consecutive slices (one may be missing), begun near the ground."""
    open_stacks: list[list[HullCircle]] = []
    for level in slices:
        free = list(level)
        for s in sorted(open_stacks, key=lambda s: -len(s)):
            near = [c for c in free if _follows(s[-1], c)]
            if near:
                best = min(near, key=lambda c: (np.hypot(c.x_m - s[-1].x_m, c.y_m - s[-1].y_m), c.x_m))
                s.append(best)
                free.remove(best)
        open_stacks.extend([c] for c in free if c.z_m < START_M)
    return [s for s in open_stacks if len(s) >= MIN_LAYERS]


def _follows(below: HullCircle, above: HullCircle) -> bool:
    if not 0.0 < above.z_m - below.z_m < 2.5 * SPACING_M:
        return False
    place = np.hypot(above.x_m - below.x_m, above.y_m - below.y_m)
    return bool(place < SAME_PLACE_M and abs(above.radius_m - below.radius_m) < SAME_RADIUS_M)


def detect_reference(
    points_m: NDArray[np.floating], up: tuple[float, float, float], leaf_m: float = LEAF_M, cluster_m: float = CLUSTER_M
) -> DetectionResult:
    """Return the trunks that the reference's slicing finds in a cloud (N, 3) of finite points."""
    cloud = voxel_centroids(np.asarray(points_m, dtype=np.float64), leaf_m)
    normal, offset = ground_plane(cloud, np.asarray(up) / np.linalg.norm(up))
    R = rotation_aligning(normal, (0.0, 0.0, 1.0))
    upright = cloud @ R.T - np.array([0.0, 0.0, offset])
    objects = upright[(upright[:, 2] > PLANE_M) & (upright[:, 2] < LIMIT_M)]
    if len(objects) < 50:
        return result_of([], R, offset, up, len(points_m))
    thickness = 4.0 * density_m(objects)
    levels = np.arange(0.3, LIMIT_M - 0.05, SPACING_M)
    stacks = stack([slice_circles(objects, float(z), thickness, cluster_m) for z in levels])
    return result_of([_trunk(s) for s in stacks], R, offset, up, len(points_m))


def _trunk(circles: list[HullCircle]) -> Trunk:
    """Return the trunk of a stack in the upright frame: upright by assumption, the mean circle."""
    x, y = float(np.mean([c.x_m for c in circles])), float(np.mean([c.y_m for c in circles]))
    nearest = min(circles, key=lambda c: abs(c.z_m - 1.3))
    radius = float(np.mean([c.radius_m for c in circles]))
    spread = float(np.std([c.radius_m for c in circles]))
    return plain_trunk(
        (x, y), radius, nearest.z_m, (circles[0].z_m, circles[-1].z_m), spread, sum(c.points for c in circles)
    )


def plain_trunk(
    xy_m: tuple[float, float], radius: float, at_m: float, seen_m: tuple[float, float], spread_m: float, points: int,
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Trunk:  # fmt: skip
    """Return a trunk of a baseline, which knows no covariance: its spread stands for the uncertainty."""
    return Trunk(
        base_m=(xy_m[0], xy_m[1], 0.0), axis=axis, radius_m=radius, radius_height_m=at_m, taper=0.0, height_seen_m=seen_m[1],
        low_seen_m=seen_m[0], sigma_xy_m=spread_m, sigma_radius_m=spread_m, arc_rad=0.0, confidence=0.5,
        layers=round((seen_m[1] - seen_m[0]) / 0.1), points=points, noise_m=spread_m,
        lean_rad=float(np.arccos(min(1.0, axis[2]))), suitable=True, remark="",
    )  # fmt: skip


def result_of(
    trunks: list[Trunk], R: Floats, offset: float, up: tuple[float, float, float], points: int
) -> DetectionResult:
    """Return trunks of the upright frame (z above the plane) in the input's frame."""
    from dataclasses import replace

    placed = []
    for t in trunks:
        base = (np.array(t.base_m) + np.array([0.0, 0.0, offset])) @ R
        axis = np.array(t.axis) @ R
        placed.append(
            replace(
                t,
                base_m=(float(base[0]), float(base[1]), float(base[2])),
                axis=(float(axis[0]), float(axis[1]), float(axis[2])),
            )
        )
    placed.sort(key=lambda t: (float(np.hypot(t.base_m[0], t.base_m[1])), t.base_m))
    ground = Ground(0.0, 0.0, 0.5, np.zeros((1, 1, 3)), seen=True, note="ground as one plane")
    return DetectionResult(tuple(placed), (), ground, up, points, 0)
