"""The bench that sets the finer map's diameters against the live ones."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from services.evaluate import bench_fine
from services.evaluate.bench import BenchOptions
from services.simulator.catalogue import scene_by_name

SCENE = "random-multi-9700"


def test_a_trees_errors_are_in_diameters_at_the_same_height() -> None:
    true = scene_by_name(SCENE).trees[0]
    fine = {
        "diameter_13_m": 2.0 * float(true.mean_radius(1.6)) + 0.003, "diameter_height_m": 1.6, "sigma_13_m": 0.004, "frames": 30,
        "taper_m_per_m": -2.0 * true.taper + 0.001, "sigma_taper": 0.002,
        "sections": [
            {"height_m": 1.6, "diameter_m": 2.0 * float(true.mean_radius(1.6)) - 0.002, "sigma_m": 0.002, "used": True},
            {"height_m": 0.2, "diameter_m": 1.0, "sigma_m": 0.002, "used": False},
        ],
    }  # fmt: skip
    row = bench_fine._tree(SCENE, 0, true.radius_m, true.radius_m + 0.005, 0.003, fine)
    assert row["live_error_m"] == pytest.approx(0.010)
    assert row["fine_error_m"] == pytest.approx(0.003, abs=1e-5)
    assert row["taper_error"] == pytest.approx(0.001, abs=1e-5)
    assert 0.0 < abs(row["limit_m"]) < 0.1 * row["true_m"]
    assert row["section_errors_m"] == [pytest.approx(-0.002, abs=1e-5)]


def test_a_smooth_trunk_could_be_told_from_one_side() -> None:
    true = scene_by_name(SCENE).trees[0]
    assert bench_fine.side_error_m(dataclasses.replace(true, bumps=0.0), 0.3) == pytest.approx(0.0, abs=1e-6)
    trees = [dataclasses.replace(true, seed=seed, radius_m=0.1) for seed in range(40)]
    shares = [bench_fine.side_error_m(tree, 0.1 * tree.seed) / 0.1 for tree in trees]
    assert 0.008 < (sum(s * s for s in shares) / 40) ** 0.5 < 0.025


def test_the_report_counts_what_was_measured_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def one(name: str, *_: object) -> dict[str, object]:
        done.append(name)
        tree = {
            "true_m": 0.2, "live_error_m": 0.006, "live_sigma_m": 0.004, "fine_error_m": -0.003, "fine_sigma_m": 0.004, "frames": 9, "limit_m": 0.002,
            "taper_error": 0.001, "taper_sigma": 0.002, "section_errors_m": [0.001, -0.003], "section_sigmas_m": [0.002, 0.002],
        }  # fmt: skip
        hidden = {"true_m": 0.1, "live_error_m": 0.001, "live_sigma_m": 0.004}
        return {"scene": name, "trees": [tree, hidden], "frames": 100, "live_s": 3.0, "fine_s": 2.0}

    monkeypatch.setattr(bench_fine, "run_scene", one)
    options = BenchOptions(out=tmp_path, scenes=("a", "b"))
    report = bench_fine.run(options)
    assert report.figures["trees"] == 4
    assert report.figures["measured"] == 2
    assert report.figures["live_diameter_rmse_m"] == pytest.approx(0.006)
    assert report.figures["fine_diameter_rmse_m"] == pytest.approx(0.003)
    assert "nearer to the truth for 2 of 2" in report.table
    assert bench_fine.run(options).figures == report.figures
    assert done == ["a", "b"]
    assert json.loads((tmp_path / "fine.jsonl").read_text().splitlines()[0])["scene"] == "a"
