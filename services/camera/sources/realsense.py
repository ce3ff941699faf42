"""An Intel RealSense through pyrealsense2 (optional extra)."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame
from services.camera.codecs import encode_colour, encode_depth
from services.camera.config import CameraConfig
from services.camera.ranging import limit_range
from services.camera.sources.base import BadFrame
from services.common.errors import InputError

_SIZE_PX = (640, 480)
_RATE_HZ = 30
_WAIT_MS = 200
"""A frame takes 33 ms; a service that waits longer than this could not stop quickly."""


def require_library() -> None:
    """Check that pyrealsense2 is installed.

    Raises:
        InputError: it is not.
    """
    if find_spec("pyrealsense2") is None:
        raise InputError("camera source realsense: pyrealsense2 is missing; install treedock[realsense]")


class RealsenseSource:
    """Live frames, depth registered to colour; it ends only when the device is gone."""

    paced = False
    name = "realsense"
    expected: int | None = None

    def __init__(self, config: CameraConfig) -> None:
        require_library()
        import pyrealsense2 as rs

        self._rs: Any = rs
        self._config = config
        settings = rs.config()
        settings.enable_stream(rs.stream.color, *_SIZE_PX, rs.format.bgr8, _RATE_HZ)
        settings.enable_stream(rs.stream.depth, *_SIZE_PX, rs.format.z16, _RATE_HZ)
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(settings)
        except RuntimeError as error:
            raise InputError(f"camera source realsense: {error}; is a camera connected to a USB 3 port?") from None
        scale_m = profile.get_device().first_depth_sensor().get_depth_scale()
        stream = profile.get_stream(rs.stream.color).as_video_stream_profile()
        self.intrinsics = _intrinsics(stream.get_intrinsics(), 1.0 / scale_m)
        self._align = rs.align(rs.stream.color)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield frames as the camera delivers them, stamped on arrival."""
        seq = 0
        while True:
            try:
                frames = self._align.process(self._pipeline.wait_for_frames(_WAIT_MS))
            except RuntimeError as error:
                yield BadFrame(time.time_ns(), f"realsense: no frame within {_WAIT_MS} ms: {error}")
                continue
            yield dataclasses.replace(self._frame(frames), seq=seq)
            seq += 1

    def _frame(self, frames: Any) -> RgbdFrame:  # noqa: ANN401 - pyrealsense2 ships no types
        colour = np.asanyarray(frames.get_color_frame().get_data())
        depth = np.asanyarray(frames.get_depth_frame().get_data())
        config = self._config
        limited = limit_range(depth, self.intrinsics.depth_scale, config.min_range_m, config.max_range_m)
        return RgbdFrame(
            stamp_ns=time.time_ns(), seq=0, intrinsics=self.intrinsics, colour=encode_colour(colour, "bgr8"),
            depth=encode_depth(limited, "z16"),
        )  # fmt: skip


def _intrinsics(device: Any, depth_scale: float) -> Intrinsics:  # noqa: ANN401
    k1, k2, p1, p2, k3 = (float(c) for c in device.coeffs)
    return Intrinsics(
        width=int(device.width), height=int(device.height), fx=float(device.fx), fy=float(device.fy),
        cx=float(device.ppx), cy=float(device.ppy), k1=k1, k2=k2, p1=p1, p2=p2, k3=k3, depth_scale=float(depth_scale),
    )  # fmt: skip
