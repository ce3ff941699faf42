"""Direct RANSAC cylinders, the second baseline: normals, two oriented points make a cylinder, most inliers win.

Objects are clustered in space first; each cluster gives cylinders until none holds enough of it (Schnabel et al.,
"Efficient RANSAC for point-cloud shape detection", 2007, section 4.1: the axis is the cross product of two normals).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import rotation_aligning
from services.detector.model import DetectionResult, Floats, Trunk
from services.detector.reference import (
    LIMIT_M,
    PLANE_M,
    RADIUS_M,
    euclidean_clusters,
    ground_plane,
    plain_trunk,
    result_of,
    voxel_centroids,
)

LEAF_M = 0.02
CLUSTER_M = 0.06
INLIER_M = 0.02
NORMAL_COSINE = 0.85
MIN_POINTS = 80
MIN_SPAN_M = 0.6
MIN_SHARE = 0.25
"""A cylinder must hold this share of the points around it."""
MAX_LEAN_COSINE = 0.88
TRIALS = 400


def normals_of(points_m: Floats, k: int = 16) -> Floats:
    """Return unit normals (N, 3) by principal components of the ``k`` nearest points."""
    from scipy.spatial import cKDTree

    _, index = cKDTree(points_m).query(points_m, k=min(k, len(points_m)))
    near = points_m[index] - points_m[index].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    return np.asarray(vectors[:, :, 0])


def _through(p: Floats, n: Floats) -> tuple[Floats, Floats, float] | None:
    """Return (point on axis, axis, radius) of the cylinder through two oriented points, (2, 3) each."""
    axis = np.cross(n[0], n[1])
    length = float(np.linalg.norm(axis))
    if length < 0.2:
        return None
    axis = axis / length * (1.0 if axis[2] >= 0.0 else -1.0)
    flat_p, flat_n = p - np.outer(p @ axis, axis), n - np.outer(n @ axis, axis)
    # where the two normals' lines meet in the plane across the axis
    A = np.stack([flat_n[0], -flat_n[1]], axis=1)
    s, *_ = np.linalg.lstsq(A, flat_p[1] - flat_p[0], rcond=None)
    centre = flat_p[0] + s[0] * flat_n[0]
    return centre, axis, float(np.linalg.norm(flat_p[0] - centre))


def _inliers(points: Floats, normals: Floats, centre: Floats, axis: Floats, radius: float) -> NDArray[np.bool_]:
    d = points - centre
    d = d - np.outer(d @ axis, axis)
    length = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
    facing = np.abs(np.einsum("ij,ij->i", d, normals)) / length
    return np.asarray((np.abs(length - radius) < INLIER_M) & (facing > NORMAL_COSINE))


def best_cylinder(
    points: Floats, normals: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats, float, NDArray[np.bool_]] | None:
    """Return (centre, axis, radius, inliers) of the cylinder with most inliers, None when there is none."""
    best, count = None, 0
    for _ in range(TRIALS):
        pair = rng.integers(0, len(points), 2)
        found = _through(points[pair], normals[pair])
        if found is None:
            continue
        centre, axis, radius = found
        if axis[2] < MAX_LEAN_COSINE or not RADIUS_M[0] <= radius <= RADIUS_M[1]:
            continue
        on = _inliers(points, normals, centre, axis, radius)
        n = int(np.count_nonzero(on))
        if n > count:
            best, count = (centre, axis, radius, on), n
    return best


def refine(points: Floats, centre: Floats, axis: Floats, radius: float) -> tuple[Floats, Floats, float]:
    """Fit axis and radius to the inliers by least squares on radial distances."""
    from scipy.optimize import least_squares

    R = rotation_aligning(axis, (0.0, 0.0, 1.0))
    P = (points - centre) @ R.T
    middle = float(P[:, 2].mean())

    def radial(x: Floats) -> Floats:
        z = P[:, 2] - middle
        return np.asarray(np.hypot(P[:, 0] - x[0] - x[2] * z, P[:, 1] - x[1] - x[3] * z) - x[4])

    x = least_squares(radial, [0.0, 0.0, 0.0, 0.0, radius], loss="soft_l1", f_scale=0.01).x
    direction = R.T @ np.array([x[2], x[3], 1.0])
    return centre + R.T @ np.array([x[0], x[1], middle]), direction / np.linalg.norm(direction), float(x[4])


def detect_cylinders(points_m: NDArray[np.floating], up: tuple[float, float, float]) -> DetectionResult:
    """Return the trunks that direct RANSAC finds in a cloud (N, 3) of finite points."""
    cloud = voxel_centroids(np.asarray(points_m, dtype=np.float64), LEAF_M)
    normal, offset = ground_plane(cloud, np.asarray(up) / np.linalg.norm(up))
    R = rotation_aligning(normal, (0.0, 0.0, 1.0))
    upright = cloud @ R.T - np.array([0.0, 0.0, offset])
    objects = upright[(upright[:, 2] > 2.0 * PLANE_M) & (upright[:, 2] < LIMIT_M)]
    rng = np.random.default_rng(1)
    trunks: list[Trunk] = []
    for members in euclidean_clusters(objects, CLUSTER_M):
        if len(members) >= MIN_POINTS:
            trunks.extend(_cluster_trunks(objects[members], rng))
    return result_of(trunks, R, offset, up, len(points_m))


def _cluster_trunks(points: Floats, rng: np.random.Generator) -> list[Trunk]:
    normals = normals_of(points)
    trunks: list[Trunk] = []
    while len(points) >= MIN_POINTS and len(trunks) < 6:
        found = best_cylinder(points, normals, rng)
        if found is None or np.count_nonzero(found[3]) < MIN_POINTS:
            break
        centre, axis, radius = refine(points[found[3]], *found[:3])
        d = points - centre
        distance = np.linalg.norm(d - np.outer(d @ axis, axis), axis=1)
        on, around = np.abs(distance - radius) < INLIER_M, distance < radius + 0.15
        z = points[on, 2]
        if len(z) < MIN_POINTS or not RADIUS_M[0] <= radius <= RADIUS_M[1]:
            break
        if np.ptp(z) >= MIN_SPAN_M and len(z) >= MIN_SHARE * np.count_nonzero(around) and axis[2] >= MAX_LEAN_COSINE:
            base = centre - axis * (centre[2] / axis[2])
            spread = float(np.std(distance[on] - radius))
            at = float(np.clip(1.3, z.min(), z.max()))
            direction = (float(axis[0]), float(axis[1]), float(axis[2]))
            trunks.append(
                plain_trunk(
                    (float(base[0]), float(base[1])),
                    radius,
                    at,
                    (float(z.min()), float(z.max())),
                    spread,
                    len(z),
                    direction,
                )
            )
        points, normals = points[~around], normals[~around]
    return trunks
