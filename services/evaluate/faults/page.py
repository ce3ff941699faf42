"""docs/faults.md, written from the table of rows: ``python -m services.evaluate.faults.page``; a test fails when they differ."""

from __future__ import annotations

from pathlib import Path

from services.evaluate.faults.rows import ROWS

PAGE = Path(__file__).parents[3] / "docs" / "faults.md"
_WHERE = {
    "flight": (
        "Missions in flight",
        "Router, recorder, preview, station, camera, navigator, autopilot and the simulator with its PX4 are the real processes "
        "under the real supervisor; slam (also the second camera's), mapper, detector and refiner are stand-ins that say what the real ones would say, with "
        "measured errors (`services/evaluate/faults/standins.py`), so that a mission costs a few seconds. Each fault strikes at a "
        "random moment between the start command and docking; a mission that it does not end gets the next one.",
    ),
    "chain": (
        "The real perception over a recording",
        "The real camera, slam, mapper, detector and refiner, fed with a rendered recording that goes forwards and backwards for as "
        "long as is needed. A tree is lost when it does not stand under its id within 5 cm again, in the same map; the mapper must hold "
        "the submaps that it had saved (every 10 s).",
    ),
    "machine": ("The machine", "What surrounds the processes."),
    "network": (
        "Several machines",
        "Network namespaces with a router between, each with a shared memory of its own; time is let run on when somebody is silent.",
    ),
    "rendered": ("Rendered", "Slow: several minutes each."),
}  # fmt: skip
_HEAD = """# Faults

Written from `services/evaluate/faults/rows.py` by `python -m services.evaluate.faults.page`; a test fails when they differ.
Run by `treedock bench faults` (`--scenes ROW,...` or a group's name for some of them; a later call goes on where the last one
stopped); the result of the last whole run stands in [benchmarks.md](benchmarks.md). What the aircraft does at each loss, and
why, stands in [safety.md](safety.md).

For every fault in flight these are measured, and the row fails when one does not hold: when somebody held or landed
(simulated time, 0.15 s are uncertain of the fault's moment), touches, how often the aircraft was armed against the start
commands given, whether the last start command is refused when it is sent once more, trees that were known before and are
not after, and that a mission that ended says why and left the aircraft disarmed. A mission that does not need the process goes
on, or holds before it ends where it needs it in the long run. A process that was killed or stopped must be back and READY
within 3.5 s of its end (what its threads waited for a processor on a busy machine is not counted), and no other process may
have been started again. What is touched between two faults counts with the second.

The simulator is no row: it is the aircraft and the world, and there is nothing to hold when they are gone. `treedock run` then
ends with that reason (`test_a_mission_whose_simulator_died_ends_and_says_so`).
"""


def rendered() -> str:
    """Return the page."""
    lines = [_HEAD]
    for group, (title, words) in _WHERE.items():
        rows = [row for row in ROWS if row.group == group]
        lines += [f"## {title}", "", words, "", "| row | what is done | what must hold |", "|---|---|---|"]
        lines += [f"| `{row.name}` | {row.done} | {row.holds} |" for row in rows]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(rendered(), encoding="utf-8")
