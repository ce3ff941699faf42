"""Moving things: clusters of unmapped surfaces followed from view to view, and where they will be in a second. Pure.

Each is a Kalman filter with constant velocity in the plane (state x, y, vx, vy; white acceleration as process noise).
What stands still is left to the grid (space.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from services.common.geometry import Matrix
from services.navigator.track import Correction

_JOIN_M = 0.30
"""Points nearer than this belong to one thing."""
_LEAST_POINTS = 4
_WIDEST_M = 1.6
"""Wider ones are walls of leaves, not somebody who walks."""
_SIGMA_M = 0.06
"""Of a cluster's middle: the camera sees its near side only, and that changes."""
_ACCEL_M_S2 = 1.5
_SPEED_M_S = 1.5
"""Of a thing just met, standard deviation."""
_GATE_M = 0.6
_MOVES_M_S, _MOVED_M, _SURE, _LOOKS = 0.30, 0.25, 3.0, 4
"""Moving: faster than this, farther from where it was first seen, so many sigmas, so many looks."""
_FORGET_S = 1.0


@dataclass(eq=False)
class Mover:
    """One followed thing."""

    state: Matrix
    """x, y, vx, vy (4,) in map."""
    P: Matrix
    radius_m: float
    first_m: Matrix
    stamp_ns: int
    seen_ns: int
    looks: int = 1

    @property
    def moving(self) -> bool:
        """Whether it moves for sure."""
        speed = float(np.hypot(self.state[2], self.state[3]))
        sigma = float(np.sqrt(max(self.P[2, 2], self.P[3, 3])))
        far = float(np.hypot(*(self.state[:2] - self.first_m))) > _MOVED_M
        return self.looks >= _LOOKS and far and speed > max(_MOVES_M_S, _SURE * sigma)

    def at(self, stamp_ns: int) -> Matrix:
        """Return where it will be (2,), at constant velocity."""
        return np.asarray(self.state[:2] + self.state[2:] * ((stamp_ns - self.stamp_ns) / 1e9))

    def predict(self, stamp_ns: int) -> None:
        """Carry the state on to ``stamp_ns``."""
        dt = max((stamp_ns - self.stamp_ns) / 1e9, 0.0)
        F = np.eye(4)
        F[0, 2] = F[1, 3] = dt
        G = np.array([[0.5 * dt * dt, 0.0], [0.0, 0.5 * dt * dt], [dt, 0.0], [0.0, dt]])
        self.state, self.P = F @ self.state, F @ self.P @ F.T + _ACCEL_M_S2**2 * G @ G.T
        self.stamp_ns = max(stamp_ns, self.stamp_ns)

    def update(self, place_m: Matrix, radius_m: float) -> None:
        """Take a sight of it."""
        S = self.P[:2, :2] + _SIGMA_M**2 * np.eye(2)
        K = self.P[:, :2] @ np.linalg.inv(S)
        self.state = self.state + K @ (place_m - self.state[:2])
        self.P = self.P - K @ self.P[:2, :]
        self.radius_m = max(0.8 * self.radius_m, radius_m)
        self.seen_ns = self.stamp_ns
        self.looks += 1


@dataclass
class Movers:
    """All followed things."""

    followed: list[Mover] = field(default_factory=list)

    def take(self, points_m: Matrix, stamp_ns: int) -> None:
        """Take the unexplained points (N, 2) of a view at ``stamp_ns``."""
        for m in self.followed:
            m.predict(stamp_ns)
        free = list(self.followed)
        for place, radius in clusters(points_m):
            near = min(free, key=lambda m: float(np.hypot(*(m.state[:2] - place))), default=None)
            if near is not None and float(np.hypot(*(near.state[:2] - place))) < _GATE_M:
                near.update(place, radius)
                free.remove(near)
            else:
                P = np.diag([_SIGMA_M**2] * 2 + [_SPEED_M_S**2] * 2)
                state = np.array([place[0], place[1], 0.0, 0.0])
                self.followed.append(Mover(state, P, radius, place.copy(), stamp_ns, stamp_ns))
        self.followed = [m for m in self.followed if (stamp_ns - m.seen_ns) / 1e9 <= _FORGET_S]

    def moving(self, now_ns: int) -> list[Mover]:
        """Return those that move and were seen lately."""
        return [m for m in self.followed if m.moving and (now_ns - m.seen_ns) / 1e9 <= _FORGET_S]

    def correct(self, c: Correction) -> None:
        """Follow a correction of the map."""
        for m in self.followed:
            m.first_m = c.point(np.array([*m.first_m, 0.0]))[:2]
            place, speed = c.point(np.array([*m.state[:2], 0.0])), c.vector(np.array([*m.state[2:], 0.0]))
            m.state = np.array([*place[:2], *speed[:2]])


def clusters(points_m: Matrix) -> list[tuple[Matrix, float]]:
    """Return middle (2,) and radius of each group of points (N, 2), none wider than a body with its arms out."""
    cells: dict[tuple[int, int], list[int]] = {}
    for n, (i, j) in enumerate(np.floor(points_m / _JOIN_M).astype(int)):
        cells.setdefault((int(i), int(j)), []).append(n)
    found = []
    left = dict.fromkeys(sorted(cells))
    while left:
        first = next(iter(left))
        del left[first]
        group, queue = list(cells[first]), [first]
        while queue:
            i, j = queue.pop()
            for there in ((i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)):
                if there in left:
                    del left[there]
                    group += cells[there]
                    queue.append(there)
        p = points_m[group]
        extent = p.max(axis=0) - p.min(axis=0)
        if len(group) >= _LEAST_POINTS and float(np.hypot(*extent)) <= _WIDEST_M:
            middle = 0.5 * (p.max(axis=0) + p.min(axis=0))
            found.append((middle, max(0.5 * float(np.hypot(*extent)), 0.1)))
    return found


def conflict(
    here_m: Matrix, velocity_m_s: Matrix, movers: list[Mover], now_ns: int, keep_m: float, ahead_s: float = 1.0
) -> Mover | None:
    """Return the first moving thing that comes within ``keep_m`` of its surface during the next ``ahead_s``.

    Both go on at constant velocity; one that is leaving already is no conflict.
    """
    times = np.linspace(0.0, ahead_s, 11)
    for m in movers:
        start = m.at(now_ns)
        apart = (start - here_m) + times[:, None] * (m.state[2:] - velocity_m_s)
        gap = np.hypot(apart[:, 0], apart[:, 1]) - m.radius_m
        nearest = int(np.argmin(gap))
        if gap[nearest] < keep_m and (nearest > 0 or gap[-1] <= gap[0]):
            return m
    return None
