"""The camera as the kernels need it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.slam.config import SlamConfig
from services.slam.features import grid_size

F64 = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Constants of one camera with one configuration."""

    array: F64
    """(5,) fx, fy, cx, cy, and fx times the virtual baseline."""
    width: float
    height: float
    cols: int
    """Columns of the search grid."""
    scales: F64
    """(levels,) scale of each octave."""
    variance: F64
    """(levels,) variance of u and v by octave, pixels squared."""
    focal: float
    """Pixels per radian whatever the direction: the root mean square of fx and fy, which differ in a squeezed image."""


def camera_model(intrinsics: Intrinsics, config: SlamConfig) -> CameraModel:
    """Return the constants."""
    i = intrinsics
    bf = i.fx * config.baseline_m
    scales = config.scale ** np.arange(config.levels, dtype=float)
    return CameraModel(
        array=np.array([i.fx, i.fy, i.cx, i.cy, bf]),
        width=float(i.width), height=float(i.height), cols=grid_size(i)[0], scales=scales, variance=scales**2,
        focal=float(np.sqrt(0.5 * (i.fx**2 + i.fy**2))),
    )  # fmt: skip


def distortion_of(intrinsics: Intrinsics) -> F64:
    """Return (k1, k2, p1, p2, k3) of OpenCV's model."""
    i = intrinsics
    return np.array([i.k1, i.k2, i.p1, i.p2, i.k3])
