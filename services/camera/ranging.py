"""The range filter: depth the sensor cannot be trusted with becomes no data."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from services.camera.codecs import decode_depth, encode_depth


def limit_range(
    depth_raw: NDArray[np.uint16], depth_scale: float, min_range_m: float, max_range_m: float
) -> NDArray[np.uint16]:
    """Return a copy of (H, W) raw depth in which everything outside [min_range_m, max_range_m] is 0."""
    low = int(np.ceil(min_range_m * depth_scale))
    high = int(min(np.floor(max_range_m * depth_scale), np.iinfo(np.uint16).max))
    return np.where((depth_raw >= low) & (depth_raw <= high), depth_raw, np.uint16(0))


def limit_frame(frame: RgbdFrame, min_range_m: float, max_range_m: float) -> RgbdFrame:
    """Return a raw (``z16``) frame with its depth limited.

    Raises:
        FrameError: the depth bytes do not fit the intrinsics.
    """
    i = frame.intrinsics
    depth = decode_depth(frame.depth, frame.depth_encoding, i.width, i.height)
    limited = limit_range(depth, i.depth_scale, min_range_m, max_range_m)
    return dataclasses.replace(frame, depth=encode_depth(limited, "z16"), depth_encoding="z16")
