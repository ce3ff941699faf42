"""When a frame becomes a keyframe."""

from __future__ import annotations

import numpy as np

from services.slam.config import SlamConfig
from services.slam.tracking import Tracked

_BACKLOG = 2
"""With so many keyframes waiting for mapping a frame that is only less well seen makes no other."""


class KeyframeRule:
    """At once when close points run out; else when the inliers have fallen to a share of the most since the last one."""

    def __init__(self, config: SlamConfig) -> None:
        self._config = config
        self._peak = 0

    def made(self) -> None:
        """Begin to count anew."""
        self._peak = 0

    def wants(self, frame: Tracked, waiting: int) -> bool:
        """Return whether the frame should be one; ``waiting`` keyframes have not been mapped yet."""
        config, f = self._config, frame.features
        close = (f.depth >= config.min_depth_m) & (f.depth <= config.max_depth_m)
        tracked = int(np.count_nonzero(close & (frame.point >= 0)))
        untracked = int(np.count_nonzero(close & (frame.point < 0)))
        if tracked < config.close_tracked_min and untracked > config.close_untracked_max:
            return True
        self._peak = max(self._peak, frame.inliers)
        return waiting < _BACKLOG and frame.inliers < config.keyframe_ratio * self._peak
