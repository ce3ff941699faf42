"""Whether the GPS is believed: what it says against what the cameras saw, over several windows. Pure.

One fix that lies is met by the filter's gate. A receiver that is dragged away slowly passes any gate; it is caught because
its way over 5 to 80 s is not the way of the aircraft. What it did since then is taken back by the caller.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from services.common.geometry import Matrix, rotation_z
from services.fusion.config import FusionConfig

WINDOWS_S = (5.0, 10.0, 20.0, 40.0, 80.0)
_MEAN_S = 1.0
"""Both ends of a window are means over so long."""
_GATED_IN_A_ROW_S = 1.5
_LEAST = 3
_KEPT = 900


@dataclass(frozen=True, slots=True)
class _Heard:
    stamp_ns: int
    p_W_m: Matrix
    fix_m: Matrix
    flown_m: float


@dataclass
class Jury:
    """Takes fixes with the aircraft's places one after the other and says whether their difference stands still."""

    config: FusionConfig
    distrusted_until_ns: int = -1
    why: str = ""
    _heard: deque[_Heard] = field(default_factory=lambda: deque(maxlen=_KEPT))
    _gated_since_ns: int | None = None

    def trusted(self, stamp_ns: int) -> bool:
        """Whether the receiver is believed at a moment."""
        return stamp_ns >= self.distrusted_until_ns

    def hear(
        self, stamp_ns: int, p_W_m: Matrix, fix_m: Matrix, yaw_rad: float, *, flown_m: float, gated: bool, scale: float
    ) -> int | None:
        """Take a fix; when it makes the receiver distrusted (again), return the moment since when it may have lied."""
        self._heard.append(_Heard(stamp_ns, p_W_m.copy(), fix_m.copy(), flown_m))
        if not gated:
            self._gated_since_ns = None
        elif self._gated_since_ns is None:
            self._gated_since_ns = stamp_ns
        since_ns = self._jumped(stamp_ns)
        if since_ns is None:
            since_ns = self._dragged(rotation_z(yaw_rad), scale)
        if since_ns is not None:
            self.distrusted_until_ns = stamp_ns + round(self.config.gps_noise.distrust_s * 1e9)
        return since_ns

    def forget(self) -> None:
        """Begin anew: the windows hold what was before."""
        self._heard.clear()
        self._gated_since_ns = None

    def _jumped(self, stamp_ns: int) -> int | None:
        since_ns = self._gated_since_ns
        if since_ns is None or stamp_ns - since_ns < _GATED_IN_A_ROW_S * 1e9:
            return None
        self.why = "its fixes are not where the aircraft can be"
        return since_ns

    def _dragged(self, R_E_W: Matrix, scale: float) -> int | None:
        new = self._mean(self._heard[-1].stamp_ns, R_E_W)
        for window_s in WINDOWS_S:
            begin_ns = self._heard[-1].stamp_ns - round(window_s * 1e9)
            old = self._mean(begin_ns, R_E_W)
            if new is None or old is None:
                continue
            moved_m = float(np.linalg.norm(new[0] - old[0]))
            limit_m = self.config.gps_noise.consistent_sigmas * self._sigma_m(window_s, new[1] - old[1], scale)
            if moved_m > limit_m:
                self.why = f"in {window_s:.0f} s it moved {moved_m:.1f} m away from the aircraft's way; {limit_m:.1f} m may be its error"
                return begin_ns - round(_MEAN_S * 1e9)
        return None

    def _mean(self, until_ns: int, R_E_W: Matrix) -> tuple[Matrix, float] | None:
        """Return the mean horizontal difference over the second that ends at a moment, and the metres flown until then."""
        near = [h for h in self._heard if 0 <= until_ns - h.stamp_ns < _MEAN_S * 1e9]
        if len(near) < _LEAST:
            return None
        return np.mean([(h.fix_m - R_E_W @ h.p_W_m)[:2] for h in near], axis=0), near[-1].flown_m

    def _sigma_m(self, window_s: float, flown_m: float, scale: float) -> float:
        n, d = self.config.gps_noise, self.config.drift
        white = (scale * n.white_m) ** 2 * 2.0 / _LEAST
        slow = 2.0 * (scale * n.slow_m) ** 2 * (1.0 - math.exp(-window_s / n.slow_s))
        drift = d.shift_m**2 * flown_m + d.turn_rad**2 * flown_m**3
        return math.sqrt(white + slow + drift)
