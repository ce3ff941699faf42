"""The GPS side of fusion: fixes wait for the aircraft's place at their moment, are judged, and move the map on the earth."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from schemas.fusion import GpsTrust
from services.common.geometry import Matrix, rotation_z
from services.fusion.config import FusionConfig
from services.fusion.geo import GeoFilter, GeoState
from services.fusion.jury import Jury
from services.fusion.smoother import State
from services.fusion.values import GpsReading

_NEAR_NS = 300_000_000
_SNAPSHOT_NS = 1_000_000_000
_SNAPSHOTS = 100
_SILENT_NS = 2_000_000_000
_PLACED_NS = 1_000_000_000
"""Without cameras one fix a second is used: those in between share its slow error."""
_DOUBT = 2.0
"""Its covariance is taken so many times, for the same reason."""
_BLIND_M, _BLIND_M_S2 = 0.1, 0.05
"""By how much the IMU alone may have gone astray: as an acceleration does that is 0.1 m/s^2 off (a tilt of half a degree)."""


@dataclass(frozen=True, slots=True)
class Placement:
    """A fix for the smoother: the antenna's place in W."""

    index: int
    position_W_m: Matrix
    covariance: Matrix


class GpsDesk:
    """Fixes in, judged one by one; ``geo`` holds where the world stands on the earth."""

    def __init__(self, config: FusionConfig) -> None:
        self._config = config
        self.geo = GeoFilter(config)
        self.jury = Jury(config)
        self.used = self.refused = 0
        self.caught_ns: list[int] = []
        """When the receiver was found out, each time that it had been believed."""
        self._waiting: deque[GpsReading] = deque(maxlen=50)
        self._before: deque[tuple[int, GeoState, float]] = deque(maxlen=_SNAPSHOTS)
        self._flown_m = 0.0
        self._last_m: Matrix | None = None
        self._last_ns = self._placed_ns = self._blind_ns = -1
        self._doubted = False

    def take(self, fix: GpsReading) -> None:
        """Queue a fix; it is used once the aircraft's place at its moment is known."""
        if fix.stamp_ns > self._last_ns:
            self._waiting.append(fix)
            self._last_ns = fix.stamp_ns

    def trust(self, now_ns: int) -> GpsTrust:
        """Return how the receiver stands."""
        if self._last_ns < 0 or now_ns - self._last_ns > _SILENT_NS:
            return "silent" if self._last_ns >= 0 else "waiting"
        if not self.jury.trusted(now_ns):
            return "distrusted"
        return "waiting" if self.geo.state is None else "trusted"

    def due(self, states: Sequence[State], *, seen: bool) -> list[Placement]:
        """Use the fixes whose moment the states have reached; ``seen``: a camera is located.

        Returns what the smoother is to take: only while no camera is, and from a trusted receiver.
        """
        out: list[Placement] = []
        while self._waiting and states and self._waiting[0].stamp_ns <= states[-1].stamp_ns:
            fix = self._waiting.popleft()
            found = _at(states, fix.stamp_ns, np.asarray(self._config.gps_noise.antenna_m))
            if found is None:
                continue
            index, p_W_m = found
            scale = max(1.0, fix.sigma_m / self._config.gps_noise.slow_m)
            if seen:
                self._judge(fix, p_W_m, scale)
            elif self._may_place(fix):
                out += self._placed(fix, index, p_W_m, scale)
        return out

    def on_earth(self, T_W_body: Matrix) -> tuple[Matrix, Matrix, float] | None:
        """Return place (east, north, up), attitude on the earth (3, 3) and horizontal sigma of a body in W, once known."""
        if self.geo.state is None:
            return None
        R = rotation_z(float(self.geo.state.x[0])) @ T_W_body[:3, :3]
        return self.geo.on_earth(T_W_body[:3, 3]), R, self.geo.sigma_m(T_W_body[:3, 3])

    def blind(self, stamp_ns: int) -> None:
        """End the windows where the cameras end: what comes after is another way."""
        self.jury.forget()
        self._last_m = None
        self._blind_ns = stamp_ns

    def _placed(self, fix: GpsReading, index: int, p_W_m: Matrix, scale: float) -> list[Placement]:
        """Return a fix for the smoother, unless it is where the IMU says that the aircraft cannot be."""
        self._placed_ns = fix.stamp_ns
        place, covariance = self.geo.in_world(p_W_m, fix.position_m, scale)
        blind_s = max(0.0, (fix.stamp_ns - self._blind_ns) * 1e-9)
        y = place - p_W_m
        doubt = covariance + (_BLIND_M + _BLIND_M_S2 * blind_s**2) ** 2 * np.eye(3)
        if float(y @ np.linalg.solve(doubt, y)) > self._config.gps_noise.gate:
            self.refused += 1
            return []
        self.used += 1
        return [Placement(index, place, _DOUBT * covariance)]

    def _may_place(self, fix: GpsReading) -> bool:
        known = self.geo.state is not None and self.jury.trusted(fix.stamp_ns)
        return known and fix.stamp_ns - self._placed_ns >= _PLACED_NS

    def _judge(self, fix: GpsReading, p_W_m: Matrix, scale: float) -> None:
        if self._last_m is not None:
            self._flown_m += float(np.linalg.norm(p_W_m - self._last_m))
        self._last_m = p_W_m
        geo, jury = self.geo, self.jury
        believed = jury.trusted(fix.stamp_ns)
        if geo.state is not None and believed and self._doubted:
            geo.widen_slow(scale, p_W_m, fix.position_m)
            self._doubted = False
        gated = False
        if geo.state is None or believed:
            squared = geo.take(fix.stamp_ns, p_W_m, fix.position_m, scale)
            gated = squared is not None and squared > self._config.gps_noise.gate
            self.used += not gated
            self.refused += gated
        else:
            self.refused += 1
        if geo.state is None:
            return
        yaw = float(geo.state.x[0])
        since_ns = jury.hear(fix.stamp_ns, p_W_m, fix.position_m, yaw, flown_m=self._flown_m, gated=gated, scale=scale)
        if since_ns is not None:
            if believed:
                self.caught_ns.append(fix.stamp_ns)
            self._take_back(since_ns, first=believed)
        elif jury.trusted(fix.stamp_ns) and (not self._before or fix.stamp_ns - self._before[-1][0] >= _SNAPSHOT_NS):
            self._before.append((fix.stamp_ns, geo.state.copy(), self._flown_m))

    def _take_back(self, since_ns: int, *, first: bool) -> None:
        """Forget what the receiver told since it may have begun to lie."""
        self._doubted = True
        if not first:
            return
        while len(self._before) > 1 and self._before[-1][0] > since_ns:
            self._before.pop()
        if self._before:
            _, state, flown_m = self._before[-1]
            self.geo.restore(state, self._flown_m - flown_m)


def _at(states: Sequence[State], stamp_ns: int, antenna_m: Matrix) -> tuple[int, Matrix] | None:
    """Return the nearest state's index and the antenna's place in W at a moment, between the two states around it."""
    k = bisect_left([s.stamp_ns for s in states], stamp_ns)
    if k == 0 or k == len(states) or states[k].stamp_ns - states[k - 1].stamp_ns > _NEAR_NS:
        return None
    a, b = states[k - 1], states[k]
    share = (stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns)
    ends = [s.T_W_body[:3, :3] @ antenna_m + s.T_W_body[:3, 3] for s in (a, b)]
    nearest = b if share > 0.5 else a
    return nearest.index, ends[0] + share * (ends[1] - ends[0])
