"""The live status of ``treedock run``: a table on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Self

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from services.cli.supervisor import Child, Supervisor
from services.cli.watch import Watch
from services.common.words import plural

_LINE_PERIOD_S = 3.0

_MAIN_RATE = {
    "camera": "camera/rgbd",
    "slam": "slam/pose",
    "mapper": "map/cloud",
    "detector": "trees/list",
    "refiner": "trees/target",
    "simulator": "sim/rgbd",
    "navigator": "mission/guidance",
    "autopilot": "vehicle/state",
}
"""The topic whose rate says that a service is doing its work."""


def stage(watch: Watch, supervisor: Supervisor) -> str:
    """Return in words where the run stands."""
    if not supervisor.all_ready:
        waiting = [c.name for c in supervisor.children.values() if not c.ready]
        return f"starting {', '.join(waiting)}"
    if watch.source_ended:
        return "finishing"
    if watch.mission is not None:
        return watch.mission.state
    if watch.pose is not None:
        return {"tracking": "mapping"}.get(watch.pose.status, watch.pose.status)
    return "waiting for the first frame"


def headline(watch: Watch, supervisor: Supervisor, expected: int | None = None) -> str:
    """Return the run in one line; ``expected`` is how many frames will come, if known."""
    trees = watch.trees.trees if watch.trees else ()
    suitable = sum(tree.suitable for tree in trees)
    parts = [
        stage(watch, supervisor),
        f"frame {watch.frames}" + (f" of {expected}" if expected else ""),
        f"{len(trees)} {plural(len(trees), 'tree')} ({suitable} suitable)",
    ]
    if watch.word:
        parts.insert(1, watch.word)
    if watch.clock is not None:
        parts.append(f"simulated {watch.clock.stamp_ns * 1e-9:.1f} s")
    if supervisor.restarts:
        parts.append(f"{supervisor.restarts} restarts")
    return ", ".join(parts)


def rate_hz(watch: Watch, name: str) -> float | None:
    """Return the rate of the service's main output, None before its first health."""
    health = watch.health.get(name)
    return None if health is None else health.rates_hz.get(_MAIN_RATE.get(name, ""), 0.0)


def _row(watch: Watch, child: Child) -> tuple[str, ...]:
    health = watch.health.get(child.name)
    state = health.state if health is not None and child.ready else ("starting" if child.alive else "dead")
    rate = rate_hz(watch, child.name) if child.name in _MAIN_RATE else None
    work = "  ".join(f"{name} {ms:.1f}" for name, ms in list(health.work_ms.items())[:4]) if health else ""
    dropped = watch.dropped().get(child.name, 0)
    note = health.note if health else ""
    return (
        child.name, state, "" if rate is None else f"{rate:.1f}", work, str(dropped or ""), str(child.restarts or ""),
        note or child.last_fault,
    )  # fmt: skip


def table(watch: Watch, supervisor: Supervisor, expected: int | None = None) -> Group:
    """Return the whole status for a terminal."""
    grid = Table(box=None, pad_edge=False, header_style="dim")
    for column in ("service", "state", "Hz", "ms per stage", "dropped", "restarts", "note"):
        grid.add_column(column, justify="right" if column in {"Hz", "dropped", "restarts"} else "left", no_wrap=True)
    styles = {"ready": "green", "degraded": "yellow", "dead": "red"}
    for child in supervisor.children.values():
        name, state, *rest = _row(watch, child)
        grid.add_row(name, Text(state, style=styles.get(state, "")), *(Text(cell) for cell in rest))
    return Group(Text(headline(watch, supervisor, expected), style="bold"), grid)


@dataclass
class Status:
    """Shows the run: live on a terminal, else a line every few seconds. A context manager."""

    watch: Watch
    supervisor: Supervisor
    console: Console
    expected: int | None = None
    _live: Live | None = None
    _told_s: float = 0.0
    _told: str = ""

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self._live = Live(console=self.console, auto_refresh=False, transient=True)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self) -> None:
        """Show the present state."""
        if self._live is not None:
            self._live.update(table(self.watch, self.supervisor, self.expected), refresh=True)
            return
        line = headline(self.watch, self.supervisor, self.expected)
        if time.monotonic() - self._told_s >= _LINE_PERIOD_S and line != self._told:
            self._told_s, self._told = time.monotonic(), line
            self.console.print(f"treedock: {line}", highlight=False, soft_wrap=True)
