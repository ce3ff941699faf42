"""From the map to the image and back: the frame along a trunk, the window to search, rays of all pixels."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.detector.refine import kernels_place
from services.detector.refine.config import SearchConfig
from services.detector.refine.model import Depth, ExpectedTree, Matrix, Sight, largest_eigenvalue_2x2

_UNDISTORT_ITERATIONS = 12
_MIN_HORIZONTAL = 0.2
_Number = TypeVar("_Number", float, Matrix)


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


def distort(x: _Number, y: _Number, i: Intrinsics) -> tuple[_Number, _Number]:
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


def project_point(x: float, y: float, z: float, i: Intrinsics) -> tuple[float, float]:
    """Return the pixel of one point before the camera."""
    x, y = x / z, y / z
    if i.distorted:
        x, y = distort(x, y, i)
    return i.fx * x + i.cx, i.fy * y + i.cy


def sight(T_map_camera: Matrix, axis: tuple[float, float, float]) -> Sight | None:
    """Return the frame along a trunk, or None when the camera looks so far up or down that it has no heading."""
    R = np.ascontiguousarray(T_map_camera[:3, :3])
    basis, forward = np.empty((3, 3)), np.empty(2)
    if not kernels_place.trunk_frame(R, np.array(axis), _MIN_HORIZONTAL, basis, forward):
        return None
    return Sight(basis @ R, basis, R[2].copy(), T_map_camera[:3, 3].copy(), forward)


def axis_point(tree: ExpectedTree, z_map_m: float) -> Matrix:
    """Return the axis's (x, y) in map at the height ``z_map_m``."""
    return np.array(axis_xy(tree, z_map_m))


def axis_xy(tree: ExpectedTree, z_map_m: float) -> tuple[float, float]:
    """Return the same as plain numbers."""
    ax, ay, az = tree.axis
    s = (z_map_m - tree.z_m) / max(az, 0.1)
    return tree.x_m + s * ax, tree.y_m + s * ay


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
    sigma = math.sqrt(largest_eigenvalue_2x2(covariance))
    return min(max(config.gate_sigmas * sigma, config.min_gate_m), config.max_gate_m)


def window(
    tree: ExpectedTree, T_map_camera: Matrix, intrinsics: Intrinsics, reach_m: float, config: SearchConfig
) -> tuple[int, int, int, int] | None:
    """Return (u0, u1, v0, v1), ends included, of the image part where the trunk may be; None when out of view.

    The trunk between the search heights is widened by ``reach_m`` to both sides, towards the camera and away.
    """
    ends = []
    for height in (config.min_height_m, config.max_height_m):
        x, y = axis_point(tree, tree.z_m + height)
        ends.append(np.array((x, y, tree.z_m + height)))
    bounds = np.empty(4)
    T = np.ascontiguousarray(T_map_camera)
    if not kernels_place.window_bounds(ends[0], ends[1], T, _lens(intrinsics), reach_m, bounds):
        return None
    u0, u1, v0, v1 = bounds.tolist()
    if u1 < 0 or v1 < 0 or u0 > intrinsics.width - 1 or v0 > intrinsics.height - 1:
        return None
    return (
        max(int(u0), 0),
        min(int(u1) + 1, intrinsics.width - 1),
        max(int(v0), 0),
        min(int(v1) + 1, intrinsics.height - 1),
    )


@lru_cache(maxsize=4)
def _lens(i: Intrinsics) -> Matrix:
    """Return the camera as the kernels take it."""
    return np.array([i.fx, i.fy, i.cx, i.cy, i.k1, i.k2, i.p1, i.p2, i.k3])


def window_rows(v0: int, v1: int, count: int) -> NDArray[np.int64]:
    """Return up to ``count`` rows evenly spread over v0..v1."""
    step = max(1, (v1 - v0 + 1) // count)
    return np.arange(v0, v1 + 1, step, dtype=np.int64)


def bearing_of_column(column_px: float, T_map_camera: Matrix, intrinsics: Intrinsics) -> tuple[float, float]:
    """Return the bearing at which the horizontal plane through the camera meets an image column, and |du/dbearing|.

    Bearings are from the camera's forward direction on the horizontal, positive to the left. For a level camera this
    is ``-atan((u - cx) / fx)``; for a tilted one the horizon's pixels lie on a slanted line.
    """
    a, b = _horizon(T_map_camera)
    x = (column_px - intrinsics.cx) / intrinsics.fx
    if intrinsics.distorted:
        x = _undistorted_x(x, a, b, intrinsics)
    bearing = math.atan((x * a[2] - a[0]) / (b[0] - x * b[2]))
    c, s = math.cos(bearing), math.sin(bearing)
    n, d = a[0] * c + b[0] * s, a[2] * c + b[2] * s
    slope = ((b[0] * c - a[0] * s) * d - n * (b[2] * c - a[2] * s)) / d**2
    return bearing, abs(slope) * intrinsics.fx


def _horizon(T_map_camera: Matrix) -> tuple[list[float], list[float]]:
    """Return, in the camera's axes, its horizontal heading and the horizontal direction to the left of it."""
    x, y = T_map_camera[0, :3].tolist(), T_map_camera[1, :3].tolist()
    length = math.hypot(x[2], y[2])
    fx, fy = x[2] / length, y[2] / length
    return [fx * p + fy * q for p, q in zip(x, y, strict=True)], [fx * q - fy * p for p, q in zip(x, y, strict=True)]


def _undistorted_x(x_distorted: float, a: list[float], b: list[float], intrinsics: Intrinsics) -> float:
    """Return the undistorted x of a horizon pixel by fixed-point iteration."""
    x = x_distorted
    for _ in range(_UNDISTORT_ITERATIONS):
        bearing = math.atan((x * a[2] - a[0]) / (b[0] - x * b[2]))
        c, s = math.cos(bearing), math.sin(bearing)
        direction = [p * c + q * s for p, q in zip(a, b, strict=True)]
        dx, _ = distort(direction[0] / direction[2], direction[1] / direction[2], intrinsics)
        x += x_distorted - dx
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
