"""Slam's steps against the motion that was felt: which are told on, which are waited with, and when it is the IMU that is wrong."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from services.common.geometry import Matrix, inverse, log_rotation
from services.fusion.config import FusionConfig
from services.fusion.smoother import Smoother
from services.fusion.values import Located, Moved, relative

Verdict = Literal["agrees", "refused", "taken"]
"""taken: contradicted, but slam has kept to it for long enough: it is believed, and that is announced."""
_WRONG, _WITHIN_NS, _BANNED_NS = 3, 30_000_000_000, 60_000_000_000
"""An IMU that slam proved wrong so often within so long is left out for so long."""


def contradicts(seen: Moved, felt: Moved, config: FusionConfig) -> bool:
    """Whether a step that slam tells cannot be the one that was felt: by more than the limits and five sigma."""
    D = inverse(felt.T) @ seen.T
    sigma = np.sqrt(np.maximum(felt.covariance.diagonal() + seen.covariance.diagonal(), 0.0))
    far = float(np.linalg.norm(D[:3, 3])) > max(config.jump_m, 5.0 * float(sigma[3:].max()))
    turned = float(np.linalg.norm(log_rotation(D[:3, :3]))) > max(config.jump_rad, 5.0 * float(sigma[:3].max()))
    return far or turned


@dataclass
class Doubt:
    """Places that slam told and the IMU contradicts: taken over when they have stood for long enough."""

    config: FusionConfig
    since: Located | None = None
    last: Located | None = None

    def stands(self, located: Located) -> bool:
        """Take a contradicted place; True once slam has kept to it for ``believe_again_s``."""
        if self.since is None or self.last is None or not self._goes_on(located):
            self.since = located
        self.last = located
        return located.stamp_ns - self.since.stamp_ns >= self.config.believe_again_s * 1e9

    def clear(self) -> None:
        """Slam and IMU agree."""
        self.since = self.last = None

    def _goes_on(self, located: Located) -> bool:
        assert self.last is not None
        step: Matrix = located.T_map_camera[:3, 3] - self.last.T_map_camera[:3, 3]
        return located.epoch == self.last.epoch and float(np.linalg.norm(step)) < self.config.jump_m


@dataclass
class Guard:
    """Judges each located frame of the first camera."""

    config: FusionConfig
    T_body_camera: Matrix
    contradicted: int = 0
    apart_m: float = 0.0
    """Between where slam and where the IMU had the camera at the last contradiction."""
    banned_until_ns: int = -1
    """Until then the IMU is not used: slam kept to what it contradicted, again and again."""
    _doubt: Doubt = field(init=False)
    _taken_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_WRONG))

    def __post_init__(self) -> None:
        self._doubt = Doubt(self.config)

    def begin(self) -> None:
        """Begin a new window."""
        self._doubt.clear()

    def judge(self, s: Smoother, index: int, anchor: Located, located: Located) -> Verdict:
        """Judge a frame against the motion since state ``index``, where slam was at ``anchor`` in the same map."""
        covariance = np.zeros((6, 6)) if index == s.last.index else s.moved(index, s.last.index).covariance
        felt = Moved(inverse(s.state(index).T_W_body) @ s.predict(located.stamp_ns), covariance)
        seen = relative(anchor, located, self.T_body_camera)
        self.apart_m = float(np.linalg.norm((inverse(felt.T) @ seen.T)[:3, 3]))
        if not contradicts(seen, felt, self.config):
            self._doubt.clear()
            return "agrees"
        if not self._doubt.stands(located):
            self.contradicted += 1
            return "refused"
        self._doubt.clear()
        self._taken_ns.append(located.stamp_ns)
        if len(self._taken_ns) == _WRONG and located.stamp_ns - self._taken_ns[0] < _WITHIN_NS:
            self.banned_until_ns = located.stamp_ns + _BANNED_NS
            self._taken_ns.clear()
        return "taken"
