"""The sensor study: every figure has a source, the chain is set for each sensor, and a flight gives the trees."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from services.detector.detect import detect_trees
from services.evaluate.detection_accuracy import judged
from services.evaluate.sensor_clouds import RIGS, depth_view, sensor_cloud
from services.evaluate.sensor_facts import FACTS, SOURCES, UNKNOWN, facts_table

SCENE = "random-single-7311"


def test_every_fact_names_its_source_or_is_unknown() -> None:
    assert list(FACTS) == [rig.name for rig in RIGS]
    for name, facts in FACTS.items():
        for key, text in dataclasses.asdict(facts).items():
            cited = re.findall(r"\[(\w+)\]", text)
            assert set(cited) <= set(SOURCES), (name, key)
            assert cited or text.startswith(UNKNOWN) or key == "technology", (name, key, text)
    assert any(line.startswith("- [KHO]") for line in facts_table())


def test_the_chain_knows_each_sensors_noise_and_range() -> None:
    sigma_m = {rig.name: float(np.hypot(9.0 * rig.per_square_m, rig.floor_m)) for rig in RIGS}
    assert sigma_m["R200"] == pytest.approx(9.0 * 0.08 / (565.0 * 0.070))
    assert sigma_m["VLP-16"] == pytest.approx(0.03)
    assert sigma_m["Kinect 2"] < sigma_m["Kinect 1"] < sigma_m["R200"] < sigma_m["D435"]
    ranges = {rig.name: (rig.mapper().min_range_m, rig.mapper().max_range_m) for rig in RIGS}
    assert ranges["Kinect 1"] == (0.8, 4.0)
    assert ranges["R200"] == (0.5, 6.0)
    assert max(far for _, far in ranges.values()) <= 8.0  # beyond stands what is no part of the truth


def test_the_lidars_flight_shows_the_tree_and_is_kept(tmp_path: Path) -> None:
    lidar = RIGS[-1]
    cloud = sensor_cloud(SCENE, lidar, tmp_path)
    result = detect_trees(cloud.points_m, (0.0, 0.0, 1.0), cloud.views, lidar.detector())
    outcome, _ = judged(cloud, result)
    assert not outcome.missed
    assert not outcome.false
    assert all(abs(match.radius_error_m) < 0.02 for match in outcome.matches)
    kept = sorted(path.name for path in tmp_path.iterdir())
    again = sensor_cloud(SCENE, lidar, tmp_path)
    assert np.array_equal(again.points_m, cloud.points_m)
    assert sorted(path.name for path in tmp_path.iterdir()) == kept
    rings = depth_view(SCENE, lidar, -1)
    assert 0.001 < np.mean(rings > 0) < 0.2
