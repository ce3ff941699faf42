"""How noisy this camera's depth is: learned from what is left of it when the map has been adjusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_LEAST = 200
"""Observations in one adjustment."""
_SHARE = 0.1
"""Of one adjustment in the running variance."""
_TOGETHER = 2.0
"""Depth errs in patches: many observations of it tell less than as many independent ones, and a camera's own pattern looks
like the map. A Kinect's, taken at what is seen of it, made the map of real recordings worse (fr1_xyz 0.51 to 0.59 cm)."""
_LEAST_SIGMA_PX = 0.2
"""What is weighed too much draws the map to it, and looks better than it is: never believed to be less."""


class DepthNoise:
    """A running estimate of the disparity's standard deviation, pixels; it only falls from what was assumed at first."""

    def __init__(self, assumed_px: float) -> None:
        self._assumed_px = assumed_px
        self._variance = assumed_px**2

    @property
    def sigma_px(self) -> float:
        """Return what is believed now."""
        return float(np.clip(np.sqrt(self._variance), min(_LEAST_SIGMA_PX, self._assumed_px), self._assumed_px))

    @property
    def least_info(self) -> float:
        """Return the inverse variance from which on an observation tells the sensor's noise rather than an edge's doubt."""
        return 0.5 / self._assumed_px**2

    def learn(self, residuals: F64) -> None:
        """Take the disparity residuals (N,), pixels, of one adjustment."""
        if len(residuals) < _LEAST:
            return
        sigma_px = _TOGETHER * 1.4826 * float(np.median(np.abs(residuals)))
        self._variance += _SHARE * (sigma_px**2 - self._variance)
