"""When a frame becomes a keyframe, and when there is time for all of them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from services.slam.config import SlamConfig
from services.slam.tracking import Tracked

_BACKLOG = 2
"""With so many keyframes waiting for mapping a frame that is only less well seen makes no other."""
_HARDLY = 2
"""Times the inliers of a frame that is just not lost: there a keyframe is made in any case."""
_REST_NS = 2_000_000_000


class KeyframeRule:
    """At once when close points run out; else when the inliers have fallen to a share of the most since the last one."""

    def __init__(self, config: SlamConfig) -> None:
        self._config = config
        self._peak = 0
        self._flown: deque[int] = deque()

    def follow(self, stamps_ns: Iterable[int]) -> None:
        """Choose the frames of these stamps, as another run over the same frames did, and by oneself only after the last."""
        self._flown = deque(sorted(stamps_ns))

    def made(self) -> None:
        """Begin to count anew."""
        self._peak = 0

    def wants(self, stamp_ns: int, frame: Tracked, waiting: int) -> bool:
        """Return whether the frame should be one; ``waiting`` keyframes have not been mapped yet."""
        if self._flown:
            return self._due(stamp_ns) or frame.inliers < _HARDLY * self._config.min_inliers
        config, f = self._config, frame.features
        if f.smeared:  # what it adds would lie wrong, and stay
            return False
        close = (f.depth >= config.min_depth_m) & (f.depth <= config.max_depth_m) & (f.moving_s == 0.0)
        tracked = int(np.count_nonzero(close & (frame.point >= 0)))
        untracked = int(np.count_nonzero(close & (frame.point < 0)))
        if tracked < config.close_tracked_min and untracked > config.close_untracked_max:
            return True
        self._peak = max(self._peak, frame.inliers)
        return waiting < _BACKLOG and frame.inliers < config.keyframe_ratio * self._peak

    def _due(self, stamp_ns: int) -> bool:
        """Return whether a stamp to follow has come; the frame itself may be missing, then it is the next."""
        due = False
        while self._flown and self._flown[0] <= stamp_ns:
            self._flown.popleft()
            due = True
        return due


class Rest:
    """Says once when nothing new has come for two seconds: the camera rests, and the whole map can be adjusted.

    What came after a loop was closed has only been adjusted among its neighbours: without this the map that is flown by
    stays one or two centimetres from the one that the same frames give in the end.
    """

    def __init__(self) -> None:
        self._since_ns: int | None = None
        """When the last keyframe came; None when the map has been adjusted since."""

    def begins(self, stamp_ns: int, *, made: bool) -> bool:
        """Take a located frame; ``made``: it became a keyframe."""
        if made:
            self._since_ns = stamp_ns
        if self._since_ns is None or stamp_ns - self._since_ns < _REST_NS:
            return False
        self._since_ns = None
        return True
