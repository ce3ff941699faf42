"""When the aircraft counts as docked (design.md section 5), measured over a sliding window. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix
from services.navigator.config import DockConfig

_MIN_SAMPLES = 10
_MAX_GAP_S = 0.6


@dataclass(frozen=True, slots=True)
class DockSample:
    """One measured frame: distance to the axis, bearing of the axis, camera position in map."""

    stamp_ns: int
    distance_m: float
    bearing_rad: float
    position_m: Matrix


@dataclass(frozen=True, slots=True)
class DockVerdict:
    """Docked or why not yet, with the means over the window."""

    docked: bool
    reason: str
    distance_m: float | None = None
    bearing_rad: float | None = None


class DockMonitor:
    """Keeps the last ``window_s`` of measured frames."""

    def __init__(self, config: DockConfig) -> None:
        self.config = config
        self._samples: deque[DockSample] = deque()

    def clear(self) -> None:
        """Forget everything: the map moved, or the target changed."""
        self._samples.clear()

    def add(self, sample: DockSample) -> None:
        """Take a frame; a gap in the frames begins the window anew."""
        if self._samples:
            gap_s = (sample.stamp_ns - self._samples[-1].stamp_ns) / 1e9
            if gap_s <= 0.0:
                return
            if gap_s > _MAX_GAP_S:
                self._samples.clear()
        self._samples.append(sample)
        horizon_ns = sample.stamp_ns - round(self.config.window_s * 1e9)
        while len(self._samples) > 1 and self._samples[1].stamp_ns <= horizon_ns:
            self._samples.popleft()

    def verdict(self, since_s: float = float("inf")) -> DockVerdict:
        """Judge the window; ``since_s`` is how long docking has lasted: patience ends."""
        if len(self._samples) < _MIN_SAMPLES:
            return DockVerdict(docked=False, reason=f"{len(self._samples)} frames with the target measured")
        t = np.array([s.stamp_ns - self._samples[0].stamp_ns for s in self._samples]) / 1e9
        distance = float(np.mean([s.distance_m for s in self._samples]))
        bearing = float(np.mean([s.bearing_rad for s in self._samples]))
        positions = np.array([s.position_m for s in self._samples])
        reason = self._fault(t, distance, bearing, positions)
        if not reason and since_s < self.config.prefer_s and abs(distance - self.config.aim_m) > self.config.prefer_m:
            reason = "could be nearer to the aim"
        text = f"{distance:.3f} m, {np.degrees(bearing):+z.1f} deg"
        return DockVerdict(
            docked=not reason, reason=f"{text}: {reason}" if reason else text, distance_m=distance, bearing_rad=bearing
        )

    def _fault(self, t: Matrix, distance_m: float, bearing_rad: float, positions_m: Matrix) -> str:
        c = self.config
        if t[-1] < c.window_s - 1e-3:
            return f"seen for {t[-1]:.1f} s of {c.window_s:.1f}"
        if not c.min_m + c.margin_m <= distance_m <= c.max_m - c.margin_m:
            return f"distance outside {c.min_m:.2f}..{c.max_m:.2f} m"
        if abs(bearing_rad) > c.bearing_rad:
            return "not centred"
        centred = t - t.mean()
        drift = centred @ positions_m / float(centred @ centred)
        wander = float(np.linalg.norm(positions_m - positions_m.mean(axis=0), axis=1).max())
        if float(np.linalg.norm(drift)) > c.drift_m_s or wander > c.still_m:
            return "still moving"
        return ""
