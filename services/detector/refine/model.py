"""The refiner's values: what is expected, what was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Depth = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ExpectedTree:
    """A trunk of the map: ``x_m, y_m, z_m`` is where its axis meets the ground, ``axis`` is a unit vector, upward."""

    id: int
    x_m: float
    y_m: float
    z_m: float
    axis: tuple[float, float, float]
    radius_m: float
    sigma_xy_m: float
    sigma_radius_m: float


@dataclass(frozen=True, slots=True)
class Measurement:
    """A trunk as one depth image shows it, relative to the camera."""

    tree_id: int
    bearing_rad: float
    """Horizontal angle of the axis, at the camera's height, from the camera's forward direction; positive left."""
    range_m: float
    """Horizontal distance from the camera to the axis at the camera's height."""
    radius_m: float
    image_x_px: float
    """Image column of the axis at the camera's height."""
    covariance: Matrix
    """(3, 3) of (bearing_rad, range_m, radius_m), of the depth image alone."""
    position_map_m: tuple[float, float]
    """The axis in map at the camera's height."""
    covariance_map_m2: Matrix
    """(2, 2) of ``position_map_m``, the pose's own uncertainty included."""
    rms: float
    """Root mean square of the inliers' residuals in sigmas: near 1 when the noise model holds."""
    inliers: int
    inlier_share: float
    arc_rad: float
    """Angle of the trunk's surface that was seen, about its axis."""
    columns_px: tuple[float, float]
    """Left and right edge of what was seen."""
    rows_px: tuple[int, int]
    shift_m: tuple[float, float]
    """Measured less expected position, map x and y."""
    edges_px: NDArray[np.int64]
    """(N, 3) row, left and right column of the trunk's edges in the depth image, -1 where none is seen."""


@dataclass(frozen=True, slots=True)
class Sight:
    """The camera as the refiner needs it for one tree: a frame along the trunk, with the camera in its origin.

    ``M`` (3, 3) takes optical camera vectors to (away from the camera, left, up along the trunk); a pixel with depth z
    and ray ``d = (x, y, 1)`` lies at ``z * M @ d``. A cylinder along the trunk is a circle in the first two axes.
    """

    M: Matrix
    basis: Matrix
    """(3, 3), rows: the frame's axes in map."""
    up_row: Matrix
    """(3,): ``camera_z_m + z * up_row @ d`` is a pixel's height in map."""
    camera_m: Matrix
    """(3,) the camera's position in map."""
    forward: Matrix
    """(2,) unit, horizontal heading of the camera in map."""


def inverse_2x2(m: Matrix) -> Matrix:
    """Return the inverse of an invertible (2, 2); numpy's general one takes ten times as long."""
    (a, b), (c, d) = m.tolist()
    determinant = a * d - b * c
    return np.array([[d, -b], [-c, a]]) / determinant


def largest_eigenvalue_2x2(m: Matrix) -> float:
    """Return the larger eigenvalue of a symmetric (2, 2)."""
    (a, b), (_, d) = m.tolist()
    return float(0.5 * (a + d) + math.hypot(0.5 * (a - d), b))
