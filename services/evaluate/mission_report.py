"""A mission's report.html: what happened and why, the trees, the path, the target's filters. Pure.

The data is what crossed the bus; nothing is measured here.
"""

from __future__ import annotations

import datetime as dt
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.health import Health
from schemas.navigation import MissionState
from schemas.trees import Tree
from services.common.geometry import Matrix
from services.common.words import plural
from services.evaluate.exports import Stamped
from services.evaluate.report import STYLE, filters_section, table, tree_table, trunks_section
from services.evaluate.sightings import Sightings, sightings
from services.evaluate.timeline import timeline_svg
from services.evaluate.top_view import top_view_svg

_SIMULATED_BEFORE_S = 1e9
"""Simulated time begins at zero: stamps before 2001 are no hour of any day."""


@dataclass(slots=True)
class Story:
    """What was heard of one mission."""

    uav: str = ""
    map_id: str = ""
    trajectory: list[Stamped] = field(default_factory=list)
    trees: tuple[Tree, ...] = ()
    seen: Sightings = field(default_factory=sightings)
    """Of the target, in each frame."""
    states: list[MissionState] = field(default_factory=list)
    """One per change of state or reason."""
    health: dict[str, Health] = field(default_factory=dict)
    """The latest of each service."""
    points_m: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 3), np.float32))


def mission_report(story: Story) -> bytes:
    """Return the page."""
    title = f"treedock: mission of {story.uav}"
    begin_ns = story.states[0].stamp_ns if story.states else None
    body = [
        "<!doctype html>", '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width">', f"<title>{html.escape(title)}</title>",
        f"<style>{STYLE}</style></head><body>", f"<h1>{html.escape(title)}</h1>", _verdict(story), _cards(story),
        "<h2>What happened</h2>", timeline_svg(story.states, story.seen), _events(story.states), *_choice(story),
        "<h2>Trees</h2>", tree_table(story.trees),
        "<h2>From above</h2>", top_view_svg(story.trees, story.trajectory, story.points_m),
        *trunks_section(story.trees, story.points_m), *filters_section(story.seen, begin_ns), *_services(story.health),
        "</body></html>",
    ]  # fmt: skip
    return ("\n".join(body) + "\n").encode()


def _verdict(story: Story) -> str:
    """Return how it ended in one sentence, with the hour."""
    if not story.states:
        return '<p class="verdict">No mission was heard of.</p>'
    last = story.states[-1]
    good = last.state == "landed" and last.docked_count > 0
    words = f"Docked at {last.docked_count} {plural(last.docked_count, 'tree')}. Ended {last.state.replace('_', ' ')}: {last.reason}."
    begun_s = 1e-9 * story.states[0].stamp_ns
    if begun_s > _SIMULATED_BEFORE_S:
        words += f" Begun {dt.datetime.fromtimestamp(begun_s, dt.UTC):%Y-%m-%d %H:%M:%S} UTC."
    return f'<p class="verdict {"good" if good else "warn"}">{html.escape(words)}</p>'


def _cards(story: Story) -> str:
    last = story.states[-1] if story.states else None
    docked = last.docked_count if last else 0
    path = np.array([T[:3, 3] for _, T in story.trajectory]).reshape(-1, 3)
    length_m = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()) if len(path) > 1 else 0.0
    seconds = 1e-9 * (story.states[-1].stamp_ns - story.states[0].stamp_ns) if story.states else 0.0
    holds = sum(state.state == "hold" for state in story.states)
    cards = (
        ("docked", f"{docked}", plural(docked, "tree")),
        ("ended", last.state.replace("_", " ") if last else "-", (last.reason if last else "")[:60]),
        (plural(len(story.trees), "tree"), f"{len(story.trees)}", f"{sum(t.suitable for t in story.trees)} suitable"),
        ("time", f"{seconds:.0f} s", "from the first word to the last"),
        ("way", f"{length_m:.1f} m", "of the camera"),
        (plural(holds, "hold"), f"{holds}", "failsafes below" if holds else "no failsafe held it"),
    )
    lines = [
        f"<div><small>{html.escape(a)}</small><b>{html.escape(b)}</b><small>{html.escape(c)}</small></div>"
        for a, b, c in cards
    ]
    return "\n".join(['<section class="cards">', *lines, "</section>"])


def _events(states: Sequence[MissionState]) -> str:
    if not states:
        return "<p>No mission was heard of.</p>"
    begin_ns = states[0].stamp_ns
    rows = [
        (
            f"{1e-9 * (s.stamp_ns - begin_ns):.1f}",
            s.state.replace("_", " "),
            s.reason + (f" [{s.failsafe.replace('_', ' ')}]" if s.failsafe else ""),
            "" if s.target_tree_id is None else f"{s.target_tree_id}",
            "" if s.distance_m is None else f"{s.distance_m:.2f}",
        )
        for s in states
    ]
    return table(("s", "state", "why", "tree", "distance m"), rows, left=2)


def _choice(story: Story) -> list[str]:
    """Return why this tree: the reasons with which a target was chosen."""
    chosen = [s for a, s in zip([None, *story.states], story.states, strict=False) if s.target_tree_id is not None
              and (a is None or a.target_tree_id != s.target_tree_id)]  # fmt: skip
    if not chosen:
        return []
    lines = [f"<li>tree {s.target_tree_id}: {html.escape(s.reason)}</li>" for s in chosen]
    return ["<h2>Why these trees</h2>", "<ul>", *lines, "</ul>"]


def _services(health: dict[str, Health]) -> list[str]:
    rows = []
    for name, latest in sorted(health.items()):
        times = ", ".join(f"{stage} {ms:.1f}" for stage, ms in sorted(latest.work_ms.items()))
        counted = ", ".join(f"{key} {value}" for key, value in sorted(latest.counters.items()) if value)
        rows.append((name, latest.state, times, counted, latest.note))
    if not rows:
        return []
    return ["<h2>Services at the end</h2>", table(("service", "state", "ms (median)", "counted", "note"), rows, left=5)]


def far_apart(one: Matrix, other: Matrix, step_m: float = 0.02) -> bool:
    """Return whether two poses (4, 4) are ``step_m`` or ten degrees apart: as close as a picture of the path needs them."""
    cosine = 0.5 * (float(np.trace(one[:3, :3].T @ other[:3, :3])) - 1.0)
    return float(np.linalg.norm(other[:3, 3] - one[:3, 3])) >= step_m or cosine <= math.cos(math.radians(10.0))
