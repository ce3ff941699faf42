"""What processes use: processor time and memory, and the budget of each service."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import psutil

_MB = 1e6


@dataclass(frozen=True, slots=True)
class Usage:
    """What one process used over a while."""

    cpu_cores: float
    """Processor time over wall time."""
    pss_mb: float
    """Its memory; what it shares with others is counted in parts (PSS), so that a sum counts it once."""


@dataclass(frozen=True, slots=True)
class Budget:
    """What a service may use aboard at 30 frames a second of 640x480."""

    cpu_cores: float
    pss_mb: float


TOLERANCE = 1.2
"""A service is over its budget beyond this."""


class Meter:
    """Measures processes from its making until ``stop`` (or ``read``), by name."""

    def __init__(self, pids: Mapping[str, int]) -> None:
        self._processes = {name: psutil.Process(pid) for name, pid in pids.items()}
        self._begin_s = time.monotonic()
        self._cpu_s = {name: _cpu_s(process) for name, process in self._processes.items()}
        self._cores: dict[str, float] | None = None

    def stop(self) -> None:
        """Take the processor time until now; the memory later: to ask for it holds each process up for some 10 ms."""
        elapsed_s = time.monotonic() - self._begin_s
        self._cores = {
            name: (_cpu_s(process) - self._cpu_s[name]) / elapsed_s for name, process in self._processes.items()
        }

    def read(self) -> dict[str, Usage]:
        """Return what each used; its memory now."""
        if self._cores is None:
            self.stop()
        cores = self._cores or {}
        return {
            name: Usage(cores[name], process.memory_full_info().pss / _MB) for name, process in self._processes.items()
        }


def _cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def over_budget(used: Mapping[str, Usage], budgets: Mapping[str, Budget]) -> list[str]:
    """Return in words what exceeds its budget by more than a fifth; a process without a budget does, too."""
    found = []
    for name, usage in sorted(used.items()):
        budget = budgets.get(name)
        if budget is None:
            found.append(f"{name} has no budget")
            continue
        if usage.cpu_cores > TOLERANCE * budget.cpu_cores:
            found.append(f"{name} takes {usage.cpu_cores:.2f} cores of {budget.cpu_cores:.2f}")
        if usage.pss_mb > TOLERANCE * budget.pss_mb:
            found.append(f"{name} takes {usage.pss_mb:.0f} MB of {budget.pss_mb:.0f}")
    return found


_AUTOGROUPS = Path("/proc/sys/kernel/sched_autogroup_enabled")


def group_priority() -> int:
    """Return the niceness of this session's processes against all others (man sched); 0 is the usual.

    With autogroups it is the group's; without them each process has its own, and ours tells.
    """
    try:
        if int(_AUTOGROUPS.read_text(encoding="ascii")) == 0:
            return os.getpriority(os.PRIO_PROCESS, 0)
        return int(Path("/proc/self/autogroup").read_text(encoding="ascii").split()[-1])
    except (OSError, ValueError, IndexError):
        return 0
