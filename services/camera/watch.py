"""Does the source deliver as it should? Finds stalls, skipped, repeated and reordered frames by stamps and content.

Pure: it is told stamps and the time; who calls it decides which clock that is.
"""

from __future__ import annotations

import statistics
import zlib
from collections import deque
from dataclasses import dataclass, field

from schemas.camera import RgbdFrame

STALL_S = 1.0
"""A pause this long is a stall; shorter ones are skipped frames."""
_LEARN_FROM = 5
"""Intervals before the period is known."""
_PERIOD_OVER = 31
_SKIP_FROM_PERIODS = 1.6
"""Between one period and two: jitter below, a missing frame above."""
_QUIET_FRAMES = 30
"""A fault is told until this many good frames came after it."""
_TOLD_SKIP_SHARE = 0.05
_ROW_STEP = 16


@dataclass(slots=True)
class StreamWatch:
    """Counts what went wrong with one stream; ``note`` is one line with numbers, empty when all is well."""

    stall_s: float = STALL_S
    frames: int = 0
    skipped: int = 0
    repeated: int = 0
    reordered: int = 0
    stalls: int = 0
    longest_gap_s: float = 0.0
    repeated_in_a_row: int = 0
    _last_ns: int | None = None
    _last_print: int = 0
    _intervals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_PERIOD_OVER))
    _recent_skips: deque[int] = field(default_factory=lambda: deque(maxlen=_QUIET_FRAMES))
    _quiet: int = _QUIET_FRAMES
    _silent: bool = False

    @property
    def period_s(self) -> float | None:
        """The usual time between two frames, None while it is not known."""
        if len(self._intervals_ns) < _LEARN_FROM:
            return None
        return statistics.median(self._intervals_ns) / 1e9

    def see(self, stamp_ns: int, fingerprint: int | None = None) -> None:
        """Take note of a frame; ``fingerprint`` tells whether its images are those of the frame before."""
        self.frames += 1
        known, self._silent = self._silent, False
        last, self._last_ns = self._last_ns, max(stamp_ns, self._last_ns or stamp_ns)
        same = fingerprint is not None and last is not None and fingerprint == self._last_print
        if fingerprint is not None:
            self._last_print = fingerprint
        self.repeated_in_a_row = self.repeated_in_a_row + 1 if same or stamp_ns == last else 0
        skipped, fault = 0, self.repeated_in_a_row > 0
        if fault:
            self.repeated += 1
        elif last is not None and stamp_ns < last:
            self.reordered += 1
            fault = True
        if last is not None and stamp_ns > last:
            stalled, skipped = self._gap(stamp_ns - last, known=known)
            fault = fault or stalled
        self._recent_skips.append(skipped)
        self._quiet = 0 if fault else self._quiet + 1

    def silence(self, silent_s: float) -> bool:
        """Say that nothing has come for so long; returns True when that is (still) a stall, and counts it once."""
        if self.frames == 0 or silent_s <= self.stall_s:
            return False
        if not self._silent:
            self._silent = True
            self.stalls += 1
        self.longest_gap_s = max(self.longest_gap_s, silent_s)
        self._quiet = 0
        return True

    def restart(self) -> None:
        """Forget the last frame: the source was opened again, and the pause is told elsewhere."""
        self._last_ns, self._silent = None, False

    def counts(self) -> dict[str, int]:
        """Return the counters that health and metrics.json show."""
        return {
            "skipped_frames": self.skipped, "repeated_frames": self.repeated, "reordered_frames": self.reordered,
            "stalls": self.stalls,
        }  # fmt: skip

    def note(self) -> str:
        """Return what is wrong at present: empty when the last second or two were well."""
        many_skipped = sum(self._recent_skips) > _TOLD_SKIP_SHARE * _QUIET_FRAMES
        return self.total() if self._quiet < _QUIET_FRAMES or many_skipped else ""

    def total(self) -> str:
        """Return one line on all that went wrong since the start, empty for nothing."""
        parts = [
            f"{self.skipped} frames missing" if self.skipped else "",
            f"{self.repeated} repeated" if self.repeated else "",
            f"{self.reordered} out of order" if self.reordered else "",
            f"{self.stalls} stalls, the longest {self.longest_gap_s:.1f} s" if self.stalls else "",
        ]
        told = ", ".join(part for part in parts if part)
        rate = f" (about {1 / self.period_s:.0f} Hz)" if self.period_s else ""
        return f"{told} beside {self.frames} frames{rate}" if told else ""

    def _gap(self, interval_ns: int, *, known: bool) -> tuple[bool, int]:
        """Judge the time since the frame before; return (a stall, frames skipped). ``known``: it was told already."""
        period_s, gap_s = self.period_s, interval_ns / 1e9
        if gap_s > self.stall_s and (period_s is None or gap_s > 3.0 * period_s):
            self.stalls += 0 if known else 1
            self.longest_gap_s = max(self.longest_gap_s, gap_s)
            return True, 0
        self._intervals_ns.append(interval_ns)
        if period_s is None or gap_s < _SKIP_FROM_PERIODS * period_s:
            return False, 0
        skipped = max(round(gap_s / period_s) - 1, 1)
        self.skipped += skipped
        return False, skipped


def fingerprint(frame: RgbdFrame) -> int:
    """Return a checksum over every 16th row of an uncompressed frame's images: two of a real sensor never agree."""
    width, height = frame.intrinsics.width, frame.intrinsics.height
    value = 0
    for data, row_bytes in ((frame.colour, len(frame.colour) // height), (frame.depth, 2 * width)):
        view = memoryview(data)
        for row in range(0, height, _ROW_STEP):
            value = zlib.crc32(view[row * row_bytes : (row + 1) * row_bytes], value)
    return value
