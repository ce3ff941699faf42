"""The second camera in fusion: its slam's places, joined to the smoother's states as they come. Pure."""

from __future__ import annotations

from services.common.geometry import Matrix
from services.fusion.sight import Sight
from services.fusion.smoother import Smoother
from services.fusion.values import Located, Moved, relative

_RECENT_NS = 200_000_000


class SecondEye:
    """One window's links by the second camera; its slam may answer after the state was made."""

    def __init__(self, T_body_camera: Matrix) -> None:
        self._T_body_camera = T_body_camera
        self._sight = Sight()
        self._joined: tuple[int, Located] | None = None
        """The newest state at which it is located."""
        self._checked = -1
        self._seen_ns = -1

    def begin(self) -> None:
        """Begin a new window: its states are others."""
        self._joined, self._checked = None, -1

    def take(self, stamp_ns: int, located: Located | None) -> None:
        """Take note of a frame."""
        self._sight.take(stamp_ns, located)
        if located is not None:
            self._seen_ns = stamp_ns

    def sees(self, stamp_ns: int) -> bool:
        """Whether it was located shortly before a moment."""
        return self._seen_ns >= 0 and stamp_ns - self._seen_ns < _RECENT_NS

    def join(self, s: Smoother) -> None:
        """Join states by it, as far as its slam has answered."""
        for state in s.states:
            if state.index <= self._checked:
                continue
            if state.stamp_ns > self._sight.newest_ns:
                return
            self._checked = state.index
            located = self._sight.at(state.stamp_ns)
            if located is None:
                continue
            before, self._joined = self._joined, (state.index, located)
            if before is not None and before[1].epoch == located.epoch and s.holds(before[0]):
                s.join(before[0], state.index, relative(before[1], located, self._T_body_camera))

    def step(self, s: Smoother, located: Located) -> Moved | None:
        """Return how the body moved since the last state, None when it was not located there in the same map."""
        if self._joined is None or self._joined[0] != s.last.index or self._joined[1].epoch != located.epoch:
            return None
        return relative(self._joined[1], located, self._T_body_camera)
