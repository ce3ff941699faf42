"""From the map to the image and back: the frame along a trunk, the window to search, rays of all pixels."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.detector.refine.config import SearchConfig
from services.detector.refine.model import Depth, ExpectedTree, Matrix, Sight

_MIN_FORWARD_M = 0.15
_UNDISTORT_ITERATIONS = 12
_MIN_HORIZONTAL = 0.2


@lru_cache(maxsize=4)
def ray_table(intrinsics: Intrinsics) -> tuple[Depth, Depth]:
    """Return (H, W) float32 tables of x and y of each pixel's ray (x, y, 1), distortion removed."""
    i = intrinsics
    u = (np.arange(i.width, dtype=np.float64) - i.cx) / i.fx
    v = (np.arange(i.height, dtype=np.float64) - i.cy) / i.fy
    xd, yd = np.meshgrid(u, v)
    x, y = xd.copy(), yd.copy()
    if i.distorted:
        for _ in range(_UNDISTORT_ITERATIONS):
            dx, dy = distort(x, y, i)
            x, y = x - (dx - xd), y - (dy - yd)
    return np.ascontiguousarray(x, dtype=np.float32), np.ascontiguousarray(y, dtype=np.float32)


def distort(x: Matrix, y: Matrix, i: Intrinsics) -> tuple[Matrix, Matrix]:
    """Return distorted normalised coordinates (OpenCV's model: Brown 1966 with k1 k2 k3 p1 p2)."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (i.k1 + r2 * (i.k2 + r2 * i.k3))
    return (
        x * radial + 2.0 * i.p1 * x * y + i.p2 * (r2 + 2.0 * x * x),
        y * radial + i.p1 * (r2 + 2.0 * y * y) + 2.0 * i.p2 * x * y,
    )


def project(points_camera_m: Matrix, i: Intrinsics) -> Matrix:
    """Return pixels (N, 2) of points (N, 3) before the camera."""
    x, y = points_camera_m[:, 0] / points_camera_m[:, 2], points_camera_m[:, 1] / points_camera_m[:, 2]
    if i.distorted:
        x, y = distort(x, y, i)
    return np.stack([i.fx * x + i.cx, i.fy * y + i.cy], axis=1)


def sight(T_map_camera: Matrix, axis: tuple[float, float, float]) -> Sight | None:
    """Return the frame along a trunk, or None when the camera looks so far up or down that it has no heading."""
    R = T_map_camera[:3, :3]
    horizontal = R[:2, 2]
    length = float(np.hypot(horizontal[0], horizontal[1]))
    if length < _MIN_HORIZONTAL:
        return None
    a = np.asarray(axis, dtype=np.float64)
    forward3 = np.array([horizontal[0] / length, horizontal[1] / length, 0.0])
    away = forward3 - a * float(a @ forward3)
    away /= np.linalg.norm(away)
    left = np.array([a[1] * away[2] - a[2] * away[1], a[2] * away[0] - a[0] * away[2], a[0] * away[1] - a[1] * away[0]])
    basis = np.stack([away, left, a])
    return Sight(basis @ R, basis, R[2].copy(), T_map_camera[:3, 3].copy(), forward3[:2])


def axis_point(tree: ExpectedTree, z_map_m: float) -> Matrix:
    """Return the axis's (x, y) in map at the height ``z_map_m``."""
    ax, ay, az = tree.axis
    s = (z_map_m - tree.z_m) / max(az, 0.1)
    return np.array([tree.x_m + s * ax, tree.y_m + s * ay])


def pose_offset_covariance(offset_m: Matrix, pose_covariance: Matrix) -> Matrix:
    """Return the (2, 2) covariance in map of a place ``offset_m`` (2,) from the camera that the pose alone causes.

    A rotation error r of the camera (left perturbation, map frame) turns the offset o by r x o. The error is common to
    all trees nearby.
    """
    ox, oy = offset_m
    J = np.array([[1.0, 0.0, 0.0, 0.0, 0.0, -oy], [0.0, 1.0, 0.0, 0.0, 0.0, ox]])
    return J @ pose_covariance @ J.T


def gate_m(covariance: Matrix, config: SearchConfig) -> float:
    """Return how far from its expected place a tree is looked for."""
    half_trace = 0.5 * (covariance[0, 0] + covariance[1, 1])
    spread = np.hypot(0.5 * (covariance[0, 0] - covariance[1, 1]), covariance[0, 1])
    return float(np.clip(config.gate_sigmas * np.sqrt(half_trace + spread), config.min_gate_m, config.max_gate_m))


def window(
    tree: ExpectedTree, T_map_camera: Matrix, intrinsics: Intrinsics, reach_m: float, config: SearchConfig
) -> tuple[int, int, int, int] | None:
    """Return (u0, u1, v0, v1), ends included, of the image part where the trunk may be; None when out of view.

    The trunk between the search heights is widened by ``reach_m`` to both sides, towards the camera and away.
    """
    R, t = T_map_camera[:3, :3], T_map_camera[:3, 3]
    points = []
    for height in (config.min_height_m, config.max_height_m):
        x, y = axis_point(tree, tree.z_m + height)
        points.append((x, y, tree.z_m + height))
    axis_camera = (np.array(points) - t) @ R
    steps = axis_camera[1] - axis_camera[0]
    samples = axis_camera[0] + np.linspace(0.0, 1.0, 9)[:, None] * steps
    samples = samples[samples[:, 2] > _MIN_FORWARD_M]
    if len(samples) == 0:
        return None
    pixels = project(samples, intrinsics)
    near = np.maximum(samples[:, 2] - reach_m, _MIN_FORWARD_M)
    half = intrinsics.fx * reach_m / near
    extra = intrinsics.fy * reach_m / near
    u0, u1 = np.min(pixels[:, 0] - half), np.max(pixels[:, 0] + half)
    v0, v1 = np.min(pixels[:, 1]) - 0.3 * extra.max(), np.max(pixels[:, 1]) + 0.3 * extra.max()
    if u1 < 0 or v1 < 0 or u0 > intrinsics.width - 1 or v0 > intrinsics.height - 1:
        return None
    return (
        max(int(u0), 0),
        min(int(u1) + 1, intrinsics.width - 1),
        max(int(v0), 0),
        min(int(v1) + 1, intrinsics.height - 1),
    )


def window_rows(v0: int, v1: int, count: int) -> NDArray[np.int64]:
    """Return up to ``count`` rows evenly spread over v0..v1."""
    step = max(1, (v1 - v0 + 1) // count)
    return np.arange(v0, v1 + 1, step, dtype=np.int64)


def bearing_of_column(column_px: float, T_map_camera: Matrix, intrinsics: Intrinsics) -> tuple[float, float]:
    """Return the bearing at which the horizontal plane through the camera meets an image column, and |du/dbearing|.

    Bearings are from the camera's forward direction on the horizontal, positive to the left. For a level camera this
    is ``-atan((u - cx) / fx)``; for a tilted one the horizon's pixels lie on a slanted line.
    """
    R = T_map_camera[:3, :3]
    forward = R[:2, 2] / np.hypot(R[0, 2], R[1, 2])
    a = forward[0] * R[0] + forward[1] * R[1]
    b = -forward[1] * R[0] + forward[0] * R[1]
    x = (column_px - intrinsics.cx) / intrinsics.fx
    if intrinsics.distorted:
        x = _undistorted_x(x, a, b, intrinsics)
    bearing = float(np.arctan((x * a[2] - a[0]) / (b[0] - x * b[2])))
    c, s = np.cos(bearing), np.sin(bearing)
    n, d = a[0] * c + b[0] * s, a[2] * c + b[2] * s
    slope = ((b[0] * c - a[0] * s) * d - n * (b[2] * c - a[2] * s)) / d**2
    return bearing, float(abs(slope)) * intrinsics.fx


def _undistorted_x(x_distorted: float, a: Matrix, b: Matrix, intrinsics: Intrinsics) -> float:
    """Return the undistorted x of a horizon pixel by fixed-point iteration."""
    x = x_distorted
    for _ in range(_UNDISTORT_ITERATIONS):
        bearing = np.arctan((x * a[2] - a[0]) / (b[0] - x * b[2]))
        direction = a * np.cos(bearing) + b * np.sin(bearing)
        dx, _ = distort(direction[0] / direction[2], direction[1] / direction[2], intrinsics)
        x += x_distorted - float(dx)
    return x


def place_in_map(
    bearing_rad: float, range_m: float, variances: tuple[float, float], T_map_camera: Matrix
) -> tuple[Matrix, Matrix]:
    """Return a place (2,) in map from bearing and range, and its (2, 2) covariance from ``variances`` of the two."""
    forward = T_map_camera[:2, 2] / np.hypot(T_map_camera[0, 2], T_map_camera[1, 2])
    left = np.array([-forward[1], forward[0]])
    away = np.cos(bearing_rad) * forward + np.sin(bearing_rad) * left
    across = np.array([-away[1], away[0]])
    covariance = variances[1] * np.outer(away, away) + variances[0] * range_m**2 * np.outer(across, across)
    return T_map_camera[:2, 3] + range_m * away, covariance
