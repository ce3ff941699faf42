"""From a source's frame to the one that is published: undistorted, range limited, filtered, each stage timed.

The camera service and ``process`` use the same Conditioner, so that a recording is seen as it was flown.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics, RgbdFrame
from services.camera.codecs import decode_colour, decode_depth_raw, encode_colour, encode_depth, raw
from services.camera.config import CameraConfig
from services.camera.depth.geometry import undistort, undistort_raw
from services.camera.depth.pipeline import DepthPipeline
from services.camera.ranging import limit_range

T = TypeVar("T")

_LARGEST = np.iinfo(np.uint16).max


class Conditioner:
    """Applies the configured stages; one per camera (the temporal filter remembers the last frame)."""

    def __init__(self, config: CameraConfig) -> None:
        self._config = config
        self._pipeline: DepthPipeline | None = None
        self._camera: Intrinsics | None = None
        self.stage_ms: dict[str, float] = {}
        """What each stage of the last frame took."""

    def apply(self, frame: RgbdFrame) -> RgbdFrame:
        """Return the frame uncompressed (``bgr8`` or ``none``, ``z16``) and conditioned.

        With no filter on, depth within the range keeps its exact value.

        Raises:
            FrameError: the frame's bytes cannot be decoded.
        """
        self.stage_ms = {}
        config = self._config
        frame = self._timed("decode", lambda: raw(frame))
        if config.depth.undistort and frame.intrinsics.distorted:
            frame = self._timed("undistort", lambda: undistorted(frame))
        depth = decode_depth_raw(frame)
        if not config.depth.filters:
            scale, near, far = frame.intrinsics.depth_scale, config.min_range_m, config.max_range_m
            out = self._timed("range", lambda: limit_range(depth, scale, near, far))
        else:
            out = self._filtered(frame, depth)
        return dataclasses.replace(frame, depth=encode_depth(out, "z16"), depth_encoding="z16")

    def _filtered(self, frame: RgbdFrame, depth_raw: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """Run the depth pipeline; grey guides it where it fills holes."""
        if self._pipeline is None or frame.intrinsics != self._camera:
            config = self._config
            self._pipeline = DepthPipeline(config.depth, depth_raw.shape, config.min_range_m, config.max_range_m)
            self._camera = frame.intrinsics
        scale = np.float32(frame.intrinsics.depth_scale)
        guided = self._config.depth.fill_holes and frame.colour_encoding != "none"
        grey = self._timed("grey", lambda: _grey(frame)) if guided else None
        processed = self._pipeline.process(depth_raw.astype(np.float32) / scale, grey)
        self.stage_ms |= processed.stage_ms
        return np.minimum(np.rint(processed.depth_m * scale), _LARGEST).astype(np.uint16)

    def _timed(self, stage: str, work: Callable[[], T]) -> T:
        begin = time.perf_counter()
        result = work()
        self.stage_ms[stage] = (time.perf_counter() - begin) * 1e3
        return result


def undistorted(frame: RgbdFrame) -> RgbdFrame:
    """Return a raw frame as a camera without lens distortion would take it; colour is interpolated, depth is not."""
    camera = frame.intrinsics
    colour = frame.colour
    if frame.colour_encoding != "none":
        colour = encode_colour(undistort(decode_colour(frame), camera), "bgr8")
    depth = encode_depth(undistort_raw(decode_depth_raw(frame), camera), "z16")
    plain = camera.model_copy(update={"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0})
    return dataclasses.replace(frame, intrinsics=plain, colour=colour, depth=depth)


def _grey(frame: RgbdFrame) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.cvtColor(decode_colour(frame), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
