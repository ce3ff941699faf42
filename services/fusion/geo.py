"""Where the odometry's world stands on the earth: heading, offset and the receiver's slow error, filtered. Pure numpy.

State: (yaw, t (3), e (3)) with ``fix = Rz(yaw) p_W + t + e + white``. ``t`` and ``yaw`` walk with the way flown (odometry's
drift), ``e`` is a first-order Gauss-Markov process (the receiver's). GPS moves the world on the earth, and no faster than
odometry is known to drift; it never moves a pose in the map.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from services.common.geometry import Matrix, rotation_z
from services.fusion.config import FusionConfig

_PAIRS = 400
_LEAST_PAIRS = 10
_BEGIN_YAW_RAD = 0.35
"""The heading is taken when it is known to this."""


@dataclass(slots=True)
class GeoState:
    """Mean (7,) and covariance (7, 7)."""

    x: Matrix
    P: Matrix

    def copy(self) -> GeoState:
        """Return one of its own."""
        return GeoState(self.x.copy(), self.P.copy())


@dataclass
class GeoFilter:
    """``take`` one pair after the other; ``state`` is None until the way was long enough to know a heading."""

    config: FusionConfig
    state: GeoState | None = None
    _pairs: deque[tuple[Matrix, Matrix]] = field(default_factory=lambda: deque(maxlen=_PAIRS))
    _last: tuple[int, Matrix] | None = None

    def take(self, stamp_ns: int, p_W_m: Matrix, fix_m: Matrix, scale: float) -> float | None:
        """Take a fix and the antenna's place in W at its moment; ``scale`` multiplies the receiver's sigmas.

        Returns the squared innovation (3 degrees of freedom); a fix beyond the gate is not used. None while heading and
        offset are still sought.
        """
        if self.state is None:
            self._pairs.append((p_W_m.copy(), fix_m.copy()))
            self._last = (stamp_ns, p_W_m.copy())
            self.state = self._begin(scale)
            return None
        self._pass(stamp_ns, p_W_m)
        y, H, S = self._innovation(p_W_m, fix_m, scale)
        squared = float(y @ np.linalg.solve(S, y))
        if squared <= self.config.gps_noise.gate:
            s = self.state
            K = np.linalg.solve(S, H @ s.P).T
            A = np.eye(7) - K @ H
            s.x = s.x + K @ y
            s.P = A @ s.P @ A.T + K @ self.white(scale) @ K.T
        return squared

    def white(self, scale: float) -> Matrix:
        """Return the (3, 3) covariance of a fix's noise."""
        n = self.config.gps_noise
        return np.asarray((scale * n.white_m) ** 2 * np.diag([1.0, 1.0, n.vertical_factor**2]))

    def slow(self, scale: float) -> Matrix:
        """Return the (3, 3) covariance of a receiver's slow error."""
        n = self.config.gps_noise
        return np.asarray((scale * n.slow_m) ** 2 * np.diag([1.0, 1.0, n.vertical_factor**2]))

    def on_earth(self, p_W_m: Matrix) -> Matrix:
        """Return a point (3,) of W on the earth; only after the heading is known."""
        assert self.state is not None
        return rotation_z(float(self.state.x[0])) @ p_W_m + self.state.x[1:4]

    def sigma_m(self, p_W_m: Matrix) -> float:
        """Return the horizontal standard deviation of ``on_earth``."""
        assert self.state is not None
        H = self._jacobian(p_W_m)
        H[:, 4:] = 0.0
        C = H @ self.state.P @ H.T
        return float(math.sqrt(0.5 * (C[0, 0] + C[1, 1])))

    def in_world(self, p_W_m: Matrix, fix_m: Matrix, scale: float) -> tuple[Matrix, Matrix]:
        """Return a fix as a place in W with its covariance (3, 3), near ``p_W_m``: for the time without cameras."""
        assert self.state is not None
        R = rotation_z(float(self.state.x[0]))
        _, H, S = self._innovation(p_W_m, fix_m, scale)
        del H
        return R.T @ (fix_m - self.state.x[1:4] - self.state.x[4:]), R.T @ S @ R

    def widen_slow(self, scale: float, p_W_m: Matrix, fix_m: Matrix) -> None:
        """Believe the receiver anew: its offset of now is all its own slow error, and nothing is known of that."""
        assert self.state is not None
        s = self.state
        s.x[4:] += fix_m - self.on_earth(p_W_m) - s.x[4:]
        s.P[4:, :] = s.P[:, 4:] = 0.0
        s.P[4:, 4:] = 4.0 * self.slow(scale)

    def restore(self, before: GeoState, way_m: float) -> None:
        """Go back to an earlier state; the way flown since then leaves its doubt."""
        s, d = before.copy(), self.config.drift
        s.P[1:4, 1:4] += (d.shift_m**2 * way_m + d.turn_rad**2 * way_m**3) * np.eye(3)
        s.P[0, 0] += d.turn_rad**2 * way_m
        self.state = s

    def shift_world(self, by_m: float) -> None:
        """Nobody knows how far the world's origin moved: by about so much."""
        if self.state is not None:
            self.state.P[1:4, 1:4] += by_m**2 * np.eye(3)

    def _innovation(self, p_W_m: Matrix, fix_m: Matrix, scale: float) -> tuple[Matrix, Matrix, Matrix]:
        assert self.state is not None
        H = self._jacobian(p_W_m)
        y = fix_m - self.on_earth(p_W_m) - self.state.x[4:]
        return y, H, H @ self.state.P @ H.T + self.white(scale)

    def _jacobian(self, p_W_m: Matrix) -> Matrix:
        assert self.state is not None
        H = np.zeros((3, 7))
        turned = rotation_z(float(self.state.x[0])) @ p_W_m
        H[0, 0], H[1, 0] = -turned[1], turned[0]
        H[:, 1:4] = H[:, 4:] = np.eye(3)
        return H

    def _pass(self, stamp_ns: int, p_W_m: Matrix) -> None:
        """Let time and way pass: the drift turns and shifts about the place where the aircraft is."""
        assert self.state is not None
        s, n, d = self.state, self.config.gps_noise, self.config.drift
        last_ns, last_m = self._last or (stamp_ns, p_W_m)
        self._last = (stamp_ns, p_W_m.copy())
        dt_s, way_m = max(0.0, (stamp_ns - last_ns) * 1e-9), float(np.linalg.norm(p_W_m - last_m))
        keep = math.exp(-dt_s / n.slow_s)
        s.x[4:] *= keep
        s.P[4:, :] *= keep
        s.P[:, 4:] *= keep
        s.P[4:, 4:] += (1.0 - keep**2) * self.slow(1.0)
        s.P[1:4, 1:4] += d.shift_m**2 * way_m * np.eye(3)
        turned = rotation_z(float(s.x[0])) @ p_W_m
        g = np.array([1.0, turned[1], -turned[0], 0.0, 0.0, 0.0, 0.0])
        s.P += d.turn_rad**2 * way_m * np.outer(g, g)

    def _begin(self, scale: float) -> GeoState | None:
        """Return the first state once the heading is known: the best turn about the middles (Umeyama 1991, in the plane)."""
        if len(self._pairs) < _LEAST_PAIRS:
            return None
        W, E = (np.array([pair[k] for pair in self._pairs]) for k in (0, 1))
        w, e = W - W.mean(axis=0), E - E.mean(axis=0)
        reach_m = float(np.sqrt((w[:, :2] ** 2).sum(axis=1).mean()))
        n = self.config.gps_noise
        # the slow error changes little within the way: half of it counts as if it were not common
        sigma = math.hypot(scale * n.white_m / math.sqrt(0.2 * len(W)), 0.5 * scale * n.slow_m) / max(reach_m, 1e-9)
        if 2.0 * reach_m < n.begin_m or sigma > _BEGIN_YAW_RAD:
            return None
        yaw = math.atan2(float((w[:, 0] * e[:, 1] - w[:, 1] * e[:, 0]).sum()), float((w[:, :2] * e[:, :2]).sum()))
        x, P = np.zeros(7), np.zeros((7, 7))
        x[0] = yaw
        x[1:4] = E.mean(axis=0) - rotation_z(yaw) @ W.mean(axis=0)
        middle = rotation_z(yaw) @ W.mean(axis=0)
        g = np.array([1.0, middle[1], -middle[0], 0.0])
        P[:4, :4] = sigma**2 * np.outer(g, g)
        # the middle of the fixes is known but for the slow error, which t and e share with opposite signs
        slow = self.slow(scale)
        P[1:4, 1:4] += slow + self.white(scale) / (0.2 * len(W))
        P[4:, 4:] = slow
        P[1:4, 4:] = P[4:, 1:4] = -slow
        return GeoState(x, P)
