"""Is the depth scale right? Data that no RGB-D camera measures give a wrong ``depth_scale`` away."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

_STEP_PX = 8
_OVER_FRAMES = 15
_LEAST_DATA = 12
_NEAREST_FAR_M = 0.7
"""A scene of which 95 % lie nearer than this for a second is no scene to fly in."""
_FARTHEST_MEDIAN_M = 15.0
_LEAST_IN_RANGE = 0.75
"""TUM's freiburg1_desk and _xyz have 99 and 100 %, simulated forests 89 %; with their units taken for millimetres 65 and 72 %."""


class DepthScaleWatch:
    """Looks at the depths before the range filter.

    ``note`` tells what no camera measures at present; ``total`` also that most of a recording's data were out of range:
    a scale wrong by a small factor looks like that, but so does a wide view.
    """

    def __init__(self, min_range_m: float = 0.5, max_range_m: float = 6.0) -> None:
        self._range_m = (min_range_m, max_range_m)
        self._data = self._within = 0
        self._middles_m: deque[float] = deque(maxlen=_OVER_FRAMES)
        self._fars_m: deque[float] = deque(maxlen=_OVER_FRAMES)
        self._scale = 0.0

    def see(self, depth_raw: NDArray[np.uint16], depth_scale: float) -> None:
        """Take note of a depth image (H, W), raw units."""
        sample = depth_raw[::_STEP_PX, ::_STEP_PX]
        data = sample[(sample > 0) & (sample < np.iinfo(np.uint16).max)]
        self._scale = depth_scale
        if data.size < _LEAST_DATA:
            return
        low, high = self._range_m[0] * depth_scale, self._range_m[1] * depth_scale
        self._data += data.size
        self._within += int(np.count_nonzero((data >= low) & (data <= high)))
        middle, far = np.percentile(data, [50, 95]) / depth_scale
        self._middles_m.append(float(middle))
        self._fars_m.append(float(far))

    def note(self) -> str:
        """Return what is implausible: empty, or the median and what to check."""
        if len(self._middles_m) < _OVER_FRAMES:
            return ""
        middle, far = float(np.median(self._middles_m)), float(np.median(self._fars_m))
        if middle <= _FARTHEST_MEDIAN_M and far >= _NEAREST_FAR_M:
            return ""
        return (
            f"the depth data are implausible: median {middle:.3g} m, 95 % below {far:.3g} m; "
            f"is depth_scale {self._scale:g} (units per metre) right?"
        )

    def total(self) -> str:
        """Return what is odd about all data so far: empty, or the share that is of use and what to check."""
        if self.note() or not self._data or self._within >= _LEAST_IN_RANGE * self._data:
            return self.note()
        return (
            f"only {self._within / self._data:.0%} of the depth data lie within {self._range_m[0]:g} to "
            f"{self._range_m[1]:g} m (median {float(np.median(self._middles_m)):.3g} m): is depth_scale {self._scale:g} "
            "(units per metre) right?"
        )
