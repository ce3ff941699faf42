"""Depth cameras that one could buy, as simulator cameras: image, depth's field of view, noise law, ranges.

Each figure's source stands in docs/sensors.md (``services/evaluate/sensor_facts.py``); what no source tells is as in the
simulator's own camera. A LiDAR is no camera: ``services/simulator/lidar.py``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.simulator.config import SensorConfig, SensorName
from services.simulator.render import DEFAULT_INTRINSICS


@dataclass(frozen=True, slots=True)
class CameraModel:
    """One camera. Depth is registered to the image of ``intrinsics``."""

    intrinsics: Intrinsics
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Fields of ``SensorConfig`` in which it differs from the simulator's own camera."""
    depth_view_rad: tuple[float, float] | None = None
    """Full depth field of view, across and up, where it may be narrower than the image's."""


def _pinhole(width: int, height: int, fx: float, fy: float) -> Intrinsics:
    return Intrinsics(width=width, height=height, fx=fx, fy=fy, cx=0.5 * (width - 1), cy=0.5 * (height - 1))


def _degrees(across: float, up: float) -> tuple[float, float]:
    return math.radians(across), math.radians(up)


CAMERA_MODELS: Mapping[SensorName, CameraModel] = {
    "own": CameraModel(DEFAULT_INTRINSICS),
    # sigma_z = 1.425e-3 z^2 is half a step of an eighth of a pixel at f 586 px and B 75 mm
    "kinect1": CameraModel(
        _pinhole(640, 480, 586.0, 586.0),
        {
            "focal_px": 586.0, "baseline_m": 0.075, "disparity_sigma_px": 0.0626, "disparity_step_px": 0.125,
            "min_range_m": 0.8, "fade_range_m": 4.0, "max_range_m": 5.0,
        },
    ),
    "kinect2": CameraModel(
        _pinhole(512, 424, 365.5, 365.5),
        {"law": "time_of_flight", "min_range_m": 0.5, "fade_range_m": 4.5, "max_range_m": 8.0},
    ),
    # colour of 70 x 43 degrees squeezed to 640x480, depth of 59 x 46 degrees registered to it: 61 px at each side have none
    "r200": CameraModel(
        _pinhole(640, 480, 457.0, 609.0),
        {"focal_px": 565.0, "baseline_m": 0.070, "disparity_sigma_px": 0.08, "min_range_m": 0.5, "fade_range_m": 6.0, "max_range_m": 10.0},
        _degrees(59.0, 46.0),
    ),
    # 848x480 of 87 +- 3 x 58 +- 1 degrees with square pixels
    "d435": CameraModel(
        _pinhole(848, 480, 433.0, 433.0),
        {"focal_px": 433.0, "baseline_m": 0.050, "disparity_sigma_px": 0.08, "min_range_m": 0.28, "fade_range_m": 6.0, "max_range_m": 10.0},
    ),
    "bumblebee2": CameraModel(
        _pinhole(640, 480, 492.7, 492.7),
        {"focal_px": 492.7, "baseline_m": 0.120, "disparity_sigma_px": 0.2, "min_range_m": 0.5, "fade_range_m": 10.0, "max_range_m": 15.0},
    ),
}  # fmt: skip


def settings_of(config: SensorConfig) -> SensorConfig:
    """Return the configuration with its model's figures; what was set to something else than the default stays."""
    own = SensorConfig()
    given = {name for name in SensorConfig.model_fields if getattr(config, name) != getattr(own, name)}
    figures = {name: value for name, value in CAMERA_MODELS[config.model].settings.items() if name not in given}
    return config.model_copy(update=figures)


def blind_pixels(model: CameraModel, intrinsics: Intrinsics) -> NDArray[np.bool_] | None:
    """Return (H, W) where the depth camera does not look, for the image of ``intrinsics``; None when it sees all of it."""
    if model.depth_view_rad is None:
        return None
    across, up = (math.tan(0.5 * angle) for angle in model.depth_view_rad)
    x = np.abs((np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx)
    y = np.abs((np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy)
    return np.asarray((x[None, :] > across) | (y[:, None] > up))
