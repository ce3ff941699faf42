"""A simulated GPS receiver: white and slow errors, a delay, outages, and two lies: a jump, and a slow drag (spoofing)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix
from services.simulator.px4.config import GpsConfig


@dataclass(frozen=True, slots=True)
class GpsFix:
    """One fix as the receiver gives it out."""

    given_s: float
    """When it was given out: ``delay_s`` after it was true."""
    position_ned_m: Matrix
    velocity_ned_m_s: Matrix
    sigma_m: float
    """What the receiver says of its horizontal error; of its lies it says nothing."""
    vertical_sigma_m: float


class GpsReceiver:
    """Feels the true motion with :meth:`update`; ``latest`` is the last fix given out, None without one.

    All randomness comes from ``seed``; times are seconds since the start.
    """

    def __init__(self, config: GpsConfig, seed: int) -> None:
        self._config = config
        self._rng = np.random.default_rng([seed, 404])
        self._shape = np.array([1.0, 1.0, config.vertical_factor])
        self._slow_m = config.slow_m * self._shape * self._rng.standard_normal(3)
        self._due_s = 0.0
        self._coming: deque[GpsFix] = deque()
        self.latest: GpsFix | None = None

    def update(self, elapsed_s: float, position_ned_m: Matrix, velocity_ned_m_s: Matrix) -> bool:
        """Let time pass; True when a fix was given out."""
        c = self._config
        if elapsed_s + 1e-9 >= self._due_s:
            self._due_s += 1.0 / c.rate_hz
            self._measure(elapsed_s, position_ned_m, velocity_ned_m_s)
        if not self._coming or self._coming[0].given_s > elapsed_s + 1e-9:
            return False
        self.latest = self._coming.popleft()
        return True

    def lie_m(self, elapsed_s: float) -> Matrix:
        """Return by how much the receiver is led astray (3,), NED."""
        c = self._config
        lie = np.zeros(3)
        if c.jump_at_s is not None and elapsed_s >= c.jump_at_s:
            lie[:2] += c.jump_m
        if c.drag_from_s is not None and elapsed_s > c.drag_from_s:
            lie[:2] += (elapsed_s - c.drag_from_s) * np.array(c.drag_m_s)
        return lie

    def _measure(self, elapsed_s: float, position_ned_m: Matrix, velocity_ned_m_s: Matrix) -> None:
        c = self._config
        keep = math.exp(-1.0 / (c.rate_hz * c.slow_s))
        draw = self._rng.standard_normal((3, 3))
        self._slow_m = keep * self._slow_m + math.sqrt(1.0 - keep * keep) * c.slow_m * self._shape * draw[0]
        if any(begin <= elapsed_s < end for begin, end in c.outages_s):
            return
        place = position_ned_m + self._slow_m + c.white_m * self._shape * draw[1] + self.lie_m(elapsed_s)
        velocity = velocity_ned_m_s + c.velocity_m_s * self._shape * draw[2]
        sigma = math.hypot(c.white_m, c.slow_m)
        self._coming.append(GpsFix(elapsed_s + c.delay_s, place, velocity, sigma, c.vertical_factor * sigma))
