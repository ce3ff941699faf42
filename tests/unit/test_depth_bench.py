from __future__ import annotations

import numpy as np
import pytest

from services.camera.depth.config import DepthConfig
from services.evaluate import bench_depth, depth_filters
from services.evaluate.bench import BenchOptions
from services.evaluate.depth_views import PairShot, Shot, bent
from services.simulator.render import DEFAULT_INTRINSICS


def shot(seed: int = 0) -> Shot:
    """A near board before a slanted wall, with noise, mixed pixels at the board's border, and holes."""
    rng = np.random.default_rng(seed)
    true = np.tile(np.linspace(3.0, 4.0, 640, dtype=np.float32), (480, 1))
    true[:, 200:360] = 1.5
    sensed = (true + 0.002 * true**2 * rng.normal(size=true.shape)).astype(np.float32)
    sensed[:, 360:362] = 2.4
    sensed[100:103, 250:254] = 0.0
    grey = np.where(true < 2.0, 60, 160).astype(np.uint8)
    return Shot(true, sensed, grey)


def test_the_measures_see_what_each_stage_does() -> None:
    rows = {name: bench_depth.measure(name, make, [shot()]) for name, make in bench_depth.methods().items()}
    raw, mixed = rows["raw (range only)"], rows["mixed pixels dropped"]
    assert raw.mixed > 0.1
    assert mixed.mixed < 0.1 * raw.mixed
    assert mixed.rmse_m < raw.rmse_m
    assert rows["bilateral"].inner_rmse_m < 0.8 * raw.inner_rmse_m
    assert rows["holes filled"].holes < raw.holes
    assert rows["box 5x5"].edge_rmse_m > 1.2 * raw.edge_rmse_m


def test_perfect_depth_has_no_error() -> None:
    perfect = shot()
    row = bench_depth.measure("x", lambda: depth_filters.median, [Shot(perfect.true, perfect.true, perfect.grey)])
    assert row.rmse_m < 0.005
    assert row.mixed == 0.0


def test_undistortion_and_registration_gain() -> None:
    lens = dict(bench_depth.undistortion(bent(shot())))
    ignored, corrected = lens.values()
    assert corrected < 0.2 * ignored
    T = np.eye(4)
    T[0, 3] = 0.058
    # the depth camera is 5.8 cm to the right: it sees the board further left
    true = np.full((480, 640), 3.5, np.float32)
    moved = true.copy()
    true[:, 200:360] = 1.5
    moved[:, 200 - round(0.058 * 500 / 1.5) : 360 - round(0.058 * 500 / 1.5)] = 1.5
    off, registered = dict(bench_depth.registration(PairShot(DEFAULT_INTRINSICS, T, moved, true))).values()
    assert registered < 0.3 * off


def test_the_whole_report_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    few = [shot(k) for k in range(6)]
    monkeypatch.setattr(bench_depth, "around", lambda *_: iter(few[:1]))
    monkeypatch.setattr(bench_depth, "at_rest", lambda _: few)
    monkeypatch.setattr(bench_depth, "turning", lambda _: few)
    monkeypatch.setattr(
        bench_depth, "beside", lambda _: PairShot(DEFAULT_INTRINSICS, np.eye(4), few[0].sensed, few[0].true)
    )
    report = bench_depth.run(BenchOptions(quick=True))
    assert {"pipeline_ms_p50", "rmse_raw_m", "rmse_out_m"} <= set(report.figures)
    assert all(np.isfinite(value) for value in report.figures.values())
    assert "median 5x5" in report.table
    assert report.conditions["default"] == bench_depth.told(DepthConfig())
