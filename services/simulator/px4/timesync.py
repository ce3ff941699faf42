"""The autopilot's side of TIMESYNC: learns the companion's clock, and only believes it after many samples.

Double exponential smoothing of the clock offset (Holt's linear method), with PX4's measured habits: 500 good
samples at 10 Hz before the first stamp is converted, round trips above 10 ms not used, a clock jump starts anew.
"""

from __future__ import annotations

import math

CONVERGENCE_SAMPLES = 500
MAX_ROUND_TRIP_S = 0.010
_MAX_DEVIATION_S = 0.1
_CLOCK_GRAIN_S = 1e-6
_MAX_DEVIANTS = 10
_GAIN_FIRST, _GAIN_LAST = 0.05, 0.003
_SKEW_FIRST, _SKEW_LAST = 0.05, 0.003


class Timesync:
    """Estimates ``autopilot clock - companion clock`` in seconds."""

    def __init__(self) -> None:
        self.samples = 0
        self.offset_s = 0.0
        self.slow_answers = 0
        self._skew_s = 0.0
        self._deviants = 0

    @property
    def converged(self) -> bool:
        """Whether stamps are converted from now on."""
        return self.samples >= CONVERGENCE_SAMPLES

    def update(self, now_s: float, sent_s: float, companion_s: float) -> None:
        """Take an answer: our stamp ``sent_s`` came back at ``now_s`` with the companion's ``companion_s``."""
        round_trip = now_s - sent_s
        if not -_CLOCK_GRAIN_S <= round_trip < MAX_ROUND_TRIP_S:
            self.slow_answers += 1
            return
        observed = 0.5 * (sent_s + now_s) - companion_s
        if self.converged and abs(observed - self.offset_s) > _MAX_DEVIATION_S:
            self._deviants += 1
            if self._deviants > _MAX_DEVIANTS:
                self.__init__()  # type: ignore[misc]  # a clock jump: start anew
            return
        self._deviants = 0
        self._smooth(observed)
        self.samples += 1

    def _smooth(self, observed_s: float) -> None:
        if self.samples == 0:
            self.offset_s = observed_s
            return
        progress = min(1.0, self.samples / CONVERGENCE_SAMPLES)
        late = 1.0 - math.exp(0.5 * (1.0 - 1.0 / (1.0 - progress))) if progress < 1.0 else 1.0
        gain = late * _GAIN_LAST + (1.0 - late) * _GAIN_FIRST
        skew_gain = late * _SKEW_LAST + (1.0 - late) * _SKEW_FIRST
        before = self.offset_s
        self.offset_s = gain * observed_s + (1.0 - gain) * (self.offset_s + self._skew_s)
        self._skew_s = skew_gain * (self.offset_s - before) + (1.0 - skew_gain) * self._skew_s

    def to_autopilot_s(self, stamp_s: float, now_s: float) -> float:
        """Return a companion stamp on our clock; before convergence simply ``now_s``."""
        return stamp_s + self.offset_s if self.converged else now_s
