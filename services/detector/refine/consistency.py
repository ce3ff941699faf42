"""Does one tree stay where it is while it passes through the image? With wrong intrinsics it does not.

Depth gives the range along the optical axis whatever the focal length; the sideways part is scaled by focal length true
over told, ``s``. Of a tree at the bearing b the range then comes out as ``r sqrt(cos(b)^2 + s^2 sin(b)^2)``, about
``r (1 + a sin(b)^2)`` with ``a = (s^2 - 1) / 2``; a principal point told too far to the right by ``d`` (of the focal
length) adds ``d sin(b) cos(b)``, b positive to the left. So measured over mapped range, less its mean in each pass of a
tree, is fitted by ``sin(b)`` and ``sin(b)^2``. Slam absorbs a part of it, so that the coefficients name a fault, and its
direction, not its size.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from services.detector.refine.config import ConsistencyConfig
from services.detector.refine.model import Matrix

_JUDGE_EVERY = 5
_CORRELATED = 5.0
"""Residuals of so many neighbouring frames are one."""


@dataclass(slots=True)
class Pass:
    """The frames of one tree that passes through the image: sums over (1, sin b, sin^2 b, y)."""

    tree_id: int
    mapped_m: Matrix
    first_ns: int
    last_ns: int = 0
    low_rad: float = math.inf
    high_rad: float = -math.inf
    sums: Matrix = field(default_factory=lambda: np.zeros((4, 4)))

    @property
    def frames(self) -> int:
        """How many frames there were."""
        return int(self.sums[0, 0])

    def add(self, stamp_ns: int, bearing_rad: float, ratio: float) -> None:
        """Take a frame; ``ratio``: measured over mapped range, less 1."""
        s = math.sin(bearing_rad)
        row = np.array([1.0, s, s * s, ratio])
        self.sums += np.outer(row, row)
        self.last_ns = stamp_ns
        self.low_rad, self.high_rad = min(self.low_rad, bearing_rad), max(self.high_rad, bearing_rad)

    def centred(self) -> Matrix:
        """Return (3, 3): the sums of squares and products of (sin b, sin^2 b, y) about their means."""
        n = self.sums[0, 0]
        return np.asarray(self.sums[1:, 1:] - np.outer(self.sums[0, 1:], self.sums[0, 1:]) / n)


class MapConsistency:
    """Collects passes and says what is wrong with the camera's numbers, or nothing."""

    def __init__(self, config: ConsistencyConfig) -> None:
        self._config = config
        self._passes: deque[Pass] = deque(maxlen=config.passes)
        self._broken = False
        self.fault = ""

    def interrupt(self) -> None:
        """Begin a new pass with the next frame: map or pose jumped."""
        self._broken = True

    def see(
        self, stamp_ns: int, tree_id: int, mapped_m: Matrix, camera_m: Matrix, bearing_rad: float, range_m: float
    ) -> None:
        """Take one measured frame.

        Args:
            stamp_ns: The frame's.
            tree_id: The tree's.
            mapped_m: (2,) of its axis at the camera's height in map. All of a pass is compared with the first, as a
                list that is bettered meanwhile would hide what is looked for.
            camera_m: (2,) of the camera in map.
            bearing_rad: Measured.
            range_m: Measured.
        """
        last = self._passes[-1] if self._passes else None
        late = last is None or stamp_ns - last.last_ns > self._config.pass_gap_s * 1e9
        late = late or (last is not None and stamp_ns - last.first_ns > self._config.pass_s * 1e9)
        if last is None or late or self._broken or last.tree_id != tree_id:
            if last is not None and not self._useful(last):
                self._passes.pop()
            last = Pass(tree_id, mapped_m, stamp_ns)
            self._passes.append(last)
            self._broken = False
        last.add(stamp_ns, bearing_rad, range_m / float(np.hypot(*(last.mapped_m - camera_m))) - 1.0)
        if last.frames % _JUDGE_EVERY == 0:
            self._judge()

    def _useful(self, one: Pass) -> bool:
        config = self._config
        return one.frames >= config.min_frames and one.high_rad - one.low_rad >= config.min_sweep_rad

    def _judge(self) -> None:
        config = self._config
        good = [one for one in self._passes if self._useful(one)]
        frames = sum(p.frames for p in good)
        if frames < config.min_total_frames:
            return
        S = np.sum([p.centred() for p in good], axis=0)
        coefficients, sigmas = fitted(S, frames - len(good))
        self.fault = ""
        for value, sigma, words in zip(coefficients, sigmas, (_principal_words, _focal_words), strict=True):
            if abs(value) > max(config.max_slope, config.sigmas * sigma):
                self.fault = words(float(value))


def fitted(S: Matrix, freedom: int) -> tuple[Matrix, Matrix]:
    """Return the two coefficients and their sigmas from the centred sums (3, 3); infinite where they are not told."""
    H, g = S[:2, :2], S[:2, 2]
    if np.linalg.det(H) < 1e-9 * max(float(np.trace(H)), 1e-12) ** 2:
        return np.zeros(2), np.full(2, np.inf)
    x = np.linalg.solve(H, g)
    left = max(float(S[2, 2] - x @ g), 1e-12) / max(freedom - 2, 1)
    return np.asarray(x), np.asarray(np.sqrt(np.diag(np.linalg.inv(H)) * left * _CORRELATED))


def _focal_words(slope: float) -> str:
    size = "large" if slope < 0.0 else "small"
    return (
        f"a tree's range changes across the image ({slope:+.3f} sin^2): the focal length is told too {size}, or the lens "
        "is distorted: calibrate (treedock calibrate), or name the right camera file"
    )


def _principal_words(slope: float) -> str:
    side = "right" if slope > 0.0 else "left"
    return (
        f"a tree's range changes from left to right ({slope:+.3f} sin): the principal point is told too far to the {side}, "
        "or depth and colour are not registered: calibrate (treedock calibrate), or name the right camera file"
    )
