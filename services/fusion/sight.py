"""What slam told of one camera: its recent places, and whether a new one follows from the motion that was felt. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from services.common.geometry import Matrix, exp_rotation, inverse, log_rotation, pose
from services.fusion.config import FusionConfig
from services.fusion.values import Located, Moved

_APART_NS = 150_000_000
"""Places farther apart than this are not interpolated between."""


@dataclass
class Sight:
    """The recent places of one camera."""

    _places: deque[Located] = field(default_factory=lambda: deque(maxlen=90))
    newest_ns: int = -1
    """Stamp of the last frame, located or not."""

    def take(self, stamp_ns: int, located: Located | None) -> None:
        """Take note of a frame."""
        self.newest_ns = max(self.newest_ns, stamp_ns)
        if located is not None and (not self._places or located.stamp_ns > self._places[-1].stamp_ns):
            self._places.append(located)

    def at(self, stamp_ns: int) -> Located | None:
        """Return the camera's place at a moment: told, or between two that were told."""
        after = next((p for p in self._places if p.stamp_ns >= stamp_ns), None)
        if after is None or after.stamp_ns == stamp_ns:
            return after
        before = next((p for p in reversed(self._places) if p.stamp_ns < stamp_ns), None)
        if before is None or before.epoch != after.epoch or after.stamp_ns - before.stamp_ns > _APART_NS:
            return None
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        R = before.T_map_camera[:3, :3]
        turn = share * log_rotation(R.T @ after.T_map_camera[:3, :3])
        t = (1.0 - share) * before.T_map_camera[:3, 3] + share * after.T_map_camera[:3, 3]
        return replace(after, stamp_ns=stamp_ns, T_map_camera=pose(R @ exp_rotation(turn), t))


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
