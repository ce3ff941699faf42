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


class DepthScaleWatch:
    """Looks at the depths before the range filter; ``note`` is one line, empty when they are plausible."""

    def __init__(self) -> None:
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
