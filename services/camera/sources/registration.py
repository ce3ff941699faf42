"""Depth from a camera of its own into the colour camera, by two calibrations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.camera.config import CameraConfig
from services.camera.depth.geometry import register
from services.camera.sources.camera_json import read_camera
from services.common.errors import InputError

_LARGEST = np.iinfo(np.uint16).max


class Registration:
    """Registers raw depth images of ``camera`` to ``colour``."""

    def __init__(self, camera: Intrinsics, colour: Intrinsics, T_colour_depth: NDArray[np.float64]) -> None:
        self.camera = camera
        self._colour = colour
        self._T = np.ascontiguousarray(T_colour_depth)

    def apply(self, depth_raw: NDArray[np.uint16], depth_scale: float | None = None) -> NDArray[np.uint16]:
        """Return (H, W) of the colour camera, in the colour camera's ``depth_scale``; zero where there is no data.

        ``depth_scale``: units per metre of ``depth_raw`` where the image itself tells them; else the depth camera's.
        """
        depth_m = depth_raw.astype(np.float32) / np.float32(depth_scale or self.camera.depth_scale)
        moved_m = register(depth_m, self.camera, self._colour, self._T)
        return np.minimum(np.rint(moved_m * np.float32(self._colour.depth_scale)), _LARGEST).astype(np.uint16)


def registration_for(config: CameraConfig, colour: Intrinsics) -> Registration | None:
    """Return the registration that the configuration asks for, None for a source whose depth is registered already.

    Raises:
        InputError: the depth camera's file cannot be used.
    """
    if not config.depth_camera_file:
        return None
    path = Path(config.depth_camera_file)
    found = read_camera(path)
    if found.T_colour_depth is None:
        raise InputError(
            f"{path}: T_colour_depth missing: four rows that take points of the depth camera to the colour camera"
        )
    return Registration(found.intrinsics, colour, found.T_colour_depth)
