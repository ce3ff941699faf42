"""What a long run's samples say: is memory flat, does anything leak, are the rates steady. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WARM_SHARE, WARM_S = 0.25, 600.0
"""The first part of a run, in which caches fill, is left out of slopes: a quarter, and ten minutes at least."""
LEAST_S = 1200.0
"""A shorter run says nothing of memory's slope."""
LATE_SHARE = 2.0 / 3.0
"""From here on it is looked at whether what rose has levelled off."""
_BLOCKS = 12


@dataclass(frozen=True, slots=True)
class Sample:
    """One process at one time; ``at_s`` since the run began."""

    at_s: float
    service: str
    pid: int
    rss_mb: float
    threads: int
    files: int
    cpu_s: float = 0.0
    """Processor time of the process so far."""


SHARED = Path("/dev/shm")


class SharedFiles:
    """The files of shared memory that our processes have had; other programs of the machine have theirs beside them."""

    def __init__(self, folder: Path = SHARED) -> None:
        self._folder = folder
        self._ours: set[str] = set()

    def left(self, maps: Iterable[str]) -> int:
        """Return how many of ours there are, also of processes that are gone; ``maps``: /proc/PID/maps of those that live."""
        marker = f"{self._folder}/"
        for text in maps:
            self._ours |= {line.partition(marker)[2].split()[0] for line in text.splitlines() if marker in line}
        self._ours &= {path.name for path in self._folder.iterdir()}
        return len(self._ours)


@dataclass(frozen=True, slots=True)
class Slope:
    """A line through samples: units per hour, with the standard error of it."""

    per_hour: float
    error_per_hour: float

    @property
    def rises(self) -> bool:
        """Whether it rises beyond three times its own error."""
        return self.per_hour > 3.0 * self.error_per_hour


def slope(at_s: Sequence[float], values: Sequence[float]) -> Slope:
    """Return the least-squares slope over means of blocks: neighbouring samples are not independent, blocks nearly are."""
    t, v = np.asarray(at_s) / 3600.0, np.asarray(values, dtype=float)
    blocks = min(_BLOCKS, len(t))
    if blocks < 3:
        return Slope(0.0, float("inf"))
    t = np.array([part.mean() for part in np.array_split(t, blocks)])
    v = np.array([part.mean() for part in np.array_split(v, blocks)])
    dt = t - t.mean()
    spread = float(dt @ dt)
    rate = float(dt @ v) / spread
    rest = v - v.mean() - rate * dt
    return Slope(rate, float(np.sqrt(rest @ rest / (blocks - 2) / spread)))


def of_service(samples: Sequence[Sample]) -> dict[str, float]:
    """Return the figures of one service: memory, its slope, threads and files at the beginning and at the end.

    Begin and end are medians over a tenth of the run, so that a file that is open for a moment counts for nothing.
    """
    end_s = samples[-1].at_s
    late = [s for s in samples if s.at_s >= max(WARM_SHARE * end_s, WARM_S)] or list(samples)
    tenth = max(1, len(late) // 10)
    first, last = late[:tenth], late[-tenth:]
    line = slope(*_memory(late))
    return {
        "rss_mb": round(float(np.median([s.rss_mb for s in last])), 1),
        "rss_mb_max": round(max(s.rss_mb for s in late), 1),
        "mb_per_h_late": round(slope(*_memory([s for s in samples if s.at_s >= LATE_SHARE * end_s])).per_hour, 2),
        "cores": round(_cores(samples), 3),
        "mb_per_h": round(line.per_hour, 2), "mb_per_h_error": round(min(line.error_per_hour, 1e6), 2),
        "threads": float(np.median([s.threads for s in last])),
        "threads_more": float(np.median([s.threads for s in last]) - np.median([s.threads for s in first])),
        "files": float(np.median([s.files for s in last])),
        "files_more": float(np.median([s.files for s in last]) - np.median([s.files for s in first])),
        "restarts": float(len({s.pid for s in samples}) - 1), "long_enough": float(end_s >= LEAST_S),
    }  # fmt: skip


def _memory(samples: Sequence[Sample]) -> tuple[list[float], list[float]]:
    return [s.at_s for s in samples], [s.rss_mb for s in samples]


def _cores(samples: Sequence[Sample]) -> float:
    """Return the processor time per second, of the process that was there last."""
    own = [s for s in samples if s.pid == samples[-1].pid]
    passed_s = own[-1].at_s - own[0].at_s
    return (own[-1].cpu_s - own[0].cpu_s) / passed_s if passed_s > 0.0 else 0.0


def faults_of(figures: Mapping[str, float]) -> list[str]:
    """Return in words what grows: memory by more than a hundredth of itself an hour, threads, files; and restarts."""
    found = []
    if (
        figures["long_enough"]
        and figures["mb_per_h"] > max(1.0, 0.01 * figures["rss_mb"])
        and figures["mb_per_h"] > 3.0 * figures["mb_per_h_error"]
    ):
        found.append(f"memory rises by {figures['mb_per_h']:.1f} MB/h")
    found += [
        f"{figures[f'{name}_more']:+.0f} {name}" for name in ("threads", "files") if figures[f"{name}_more"] >= 1.0
    ]
    return found + ([f"{figures['restarts']:.0f} restarts"] if figures["restarts"] else [])


def steady(rates: Sequence[float]) -> float:
    """Return the spread of a rate over the run: its standard deviation over its mean, by twelfths of the run."""
    blocks = [float(np.mean(part)) for part in np.array_split(np.asarray(rates, dtype=float), _BLOCKS) if len(part)]
    mean = float(np.mean(blocks)) if blocks else 0.0
    return float(np.std(blocks) / mean) if mean else float("inf")
