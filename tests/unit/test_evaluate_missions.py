"""The missions benchmark: rows from a run's summary, the report, what is flown again and what is not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from services.evaluate import bench_missions_rendered as rendered
from services.evaluate.bench import BenchOptions
from services.evaluate.bench_missions import run as missions


def _summary(distance: float, good: bool) -> dict[str, Any]:
    dock = {"true_distance_m": distance, "true_heading_deg": -0.5, "good": good, "distance_m": distance}
    events = [
        {"s": 1.0, "state": "hold", "reason": "something stands in the way"},
        {"s": 2.0, "state": "docked", "reason": ""},
    ]
    mission = {"state": "landed", "reason": "down", "docked": good, "docks": [dock], "touches": 0,
               "clearance_m": 0.7, "simulated_s": 60.0, "events": events}  # fmt: skip
    return {"mission": mission, "frames": 900, "duration_s": 120.0, "restarts": {}, "truth": {"false": 0}}


def test_rendered_missions_are_flown_once_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[int] = []

    def fly(seed: int) -> dict[str, Any]:
        flown.append(seed)
        return rendered.row_of(seed, _summary(0.93 if seed != 202 else 1.2, seed != 202), 0)

    monkeypatch.setattr(rendered, "fly", fly)
    said: list[str] = []
    options = BenchOptions(seed=2, out=tmp_path, count=2, rendered=True, tell=said.append)
    assert missions(options).figures["docked"] == 1
    report = missions(BenchOptions(seed=2, out=tmp_path, count=3, rendered=True, tell=said.append))
    assert flown == [201, 202, 203]
    assert report.figures["runs"] == 3
    assert report.figures["docked"] == 2
    assert report.figures["camera_hz"] == 15.0
    assert report.figures["distance_max_m"] == 1.2
    assert "something stands in the way" in report.table
    assert "NOT docked" in said[-2]


def test_a_rendered_mission_that_breaks_down_is_a_row_not_an_end() -> None:
    row = {"seed": 1, "code_of_exit": 1, "end": "failed", "reason": "bug", "docks": [], "docked": False, "touches": 0}
    report = rendered.report_of([row], 1, "v")
    assert report.figures["docked"] == 0
    assert "no: failed, bug" in report.table


def test_the_weather_of_a_seed_is_its_own_and_always_the_same() -> None:
    assert rendered.settings_of(3) == rendered.settings_of(3) != rendered.settings_of(4)
    assert json.dumps(rendered.settings_of(3)).count("simulator.") == 3
