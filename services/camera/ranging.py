"""The range filter: depth the sensor cannot be trusted with becomes no data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def limit_range(
    depth_raw: NDArray[np.uint16], depth_scale: float, min_range_m: float, max_range_m: float
) -> NDArray[np.uint16]:
    """Return a copy of (H, W) raw depth in which everything outside [min_range_m, max_range_m] is 0."""
    low = int(np.ceil(min_range_m * depth_scale))
    high = int(min(np.floor(max_range_m * depth_scale), np.iinfo(np.uint16).max))
    return np.where((depth_raw >= low) & (depth_raw <= high), depth_raw, np.uint16(0))
