"""One-dimensional constant-velocity Kalman filters (spec equations 17 to 21) for image x, range and radius."""

from __future__ import annotations

from typing import Any

import numpy as np

from services.detector.refine.config import FilterConfig
from services.detector.refine.filterpy_start import kalman_filter

_MIN_RANGE_M = 0.3


class Filter1D:
    """A quantity and its rate of change; filterpy does the sums.

    The camera's known motion enters as a control input, so that the rate holds only what that leaves unexplained.
    Process noise: a constant acceleration over each step (Bar-Shalom, Li, Kirubarajan 2001, section 6.3.2).
    """

    def __init__(self, value: float, variance: float, rate_variance: float) -> None:
        self._kalman: Any = kalman_filter()(dim_x=2, dim_z=1)
        self._kalman.x = np.array([[value], [0.0]])
        self._kalman.P = np.diag([variance, rate_variance])
        self._kalman.H = np.array([[1.0, 0.0]])
        self._kalman.B = np.array([[1.0], [0.0]])
        self._kalman.inv = np.reciprocal  # of (1, 1): numpy's general inverse takes twenty times as long

    @property
    def value(self) -> float:
        """Return the present estimate."""
        return float(self._kalman.x[0, 0])

    @property
    def variance(self) -> float:
        """Return its variance."""
        return float(self._kalman.P[0, 0])

    def predict(self, dt_s: float, moved: float, moved_variance: float, acceleration: float) -> None:
        """Move on by ``dt_s``, during which the camera's motion changed the quantity by ``moved``."""
        kalman = self._kalman
        kalman.F = np.array([[1.0, dt_s], [0.0, 1.0]])
        gain = np.array([[0.5 * dt_s * dt_s], [dt_s]])
        kalman.Q = gain @ gain.T * acceleration**2
        kalman.Q[0, 0] += moved_variance
        kalman.predict(u=np.array([[moved]]))

    def surprise(self, value: float, variance: float) -> float:
        """Return how many sigma a measurement is away from the prediction."""
        return float(abs(value - self.value) / np.sqrt(self.variance + variance))

    def update(self, value: float, variance: float) -> None:
        """Take in a measurement."""
        self._kalman.update(value, R=np.array([[variance]]))


class TargetFilter:
    """The three filters of one target, gated together: a measurement is believed as a whole or not at all."""

    def __init__(
        self, values: tuple[float, float, float], variances: tuple[float, float, float], config: FilterConfig
    ) -> None:
        self._config = config
        rates = (10.0 * config.image_x_accel_px_s2, config.range_accel_m_s2, config.radius_rate_m_s**2)
        self._filters = [Filter1D(*arguments) for arguments in zip(values, variances, rates, strict=True)]
        self._refused = 0
        self._constant = tuple((1.0 - config.white_share) * v for v in variances)
        self.innovations2 = (0.0, 0.0, 0.0)
        """Squares of the last accepted innovations over their predicted variance (NIS): near 1 on average when the noise
        is as told."""

    @property
    def values(self) -> tuple[float, float, float]:
        """Return image x (px), range (m), radius (m)."""
        x, distance, radius = (f.value for f in self._filters)
        return x, max(distance, 0.0), max(radius, 0.0)

    @property
    def variances(self) -> tuple[float, float, float]:
        """Return the variances of ``values``, with the part of the measurements' that does not average out."""
        x, distance, radius = (f.variance + c for f, c in zip(self._filters, self._constant, strict=True))
        return x, distance, radius

    def predict(self, dt_s: float, moved: tuple[float, float] | None, focal_px: float) -> None:
        """Move on; ``moved``: change of image x and range by the camera's motion, None when that is not known."""
        config = self._config
        if moved is None:
            self._filters[0].predict(dt_s, 0.0, 0.0, config.image_x_accel_px_s2 * config.blind_factor)
            self._filters[1].predict(dt_s, 0.0, 0.0, config.range_accel_m_s2 * config.blind_factor)
        else:
            step = config.pose_step_m**2
            turn = (focal_px * config.pose_step_rad) ** 2
            across = step * (focal_px / max(self._filters[1].value, _MIN_RANGE_M)) ** 2
            self._filters[0].predict(dt_s, moved[0], turn + across, config.image_x_accel_px_s2)
            self._filters[1].predict(dt_s, moved[1], step, config.range_accel_m_s2)
        self._filters[2].predict(dt_s, 0.0, 0.0, config.radius_rate_m_s)

    def update(self, values: tuple[float, float, float], variances: tuple[float, float, float]) -> bool:
        """Take in a measurement when it is believable; tell whether it was."""
        triples = list(zip(self._filters, values, variances, strict=True))
        if any(f.surprise(value, variance) > self._config.gate for f, value, variance in triples):
            self._refused += 1
            return False
        self._refused = 0
        share = self._config.white_share
        x, distance, radius = (f.surprise(value, variance * share) ** 2 for f, value, variance in triples)
        self.innovations2 = (x, distance, radius)
        for f, value, variance in triples:
            f.update(value, variance * share)
        self._constant = tuple((1.0 - share) * v for v in variances)
        return True

    @property
    def hopeless(self) -> bool:
        """Whether so many measurements in a row were refused that the filter itself must be wrong."""
        return self._refused >= self._config.restart_after
