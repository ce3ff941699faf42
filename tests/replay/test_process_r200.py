"""The R200 through the whole chain: colour squeezed (fx 457, fy 609), margins without depth; judged by the truth."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from services.common.config import TreedockConfig
from services.evaluate.ate import ate, read_trajectory
from services.evaluate.sequence import process_sequence
from services.evaluate.trees import read_trees, read_truth, score
from services.simulator.config import PathConfig, SensorConfig
from services.simulator.scene import Post, Scene, SceneTree
from services.simulator.write import write_sequence

UPRIGHT = (0.0, 0.0, 1.0)
TREES = (
    SceneTree(x_m=2.6, y_m=0.3, z_m=0.0, axis=UPRIGHT, radius_m=0.11, seed=5),
    SceneTree(x_m=-1.8, y_m=2.4, z_m=0.0, axis=(0.0, math.sin(0.1), math.cos(0.1)), radius_m=0.08, seed=6),
    SceneTree(x_m=-0.5, y_m=-3.0, z_m=0.0, axis=UPRIGHT, radius_m=0.16, seed=7),
)


@pytest.mark.timeout(300)
def test_trees_and_way_are_true(tmp_path: Path) -> None:
    scene = Scene("r200", 12, TREES, posts=(Post(2.0, -2.2, 0.06, 1.4),))
    path = PathConfig(rest_s=0.3, turn_rate_rad_s=0.8, hold_s=0.3)
    sequence, out = tmp_path / "sequence", tmp_path / "out"
    write_sequence(
        scene, sequence, rate_hz=7.5, reduced=True, path_config=path, sensor_config=SensorConfig(model="r200"), seed=4
    )
    values = process_sequence(sequence, out, TreedockConfig())
    assert values["tracked_final"] >= 0.98 * values["frames"]
    result = score(read_trees(out / "trees.json"), read_truth(sequence / "truth.json"))
    assert len(result.matches) == len(TREES), (result.missed, result.hidden)
    assert not result.false
    assert max(match.centre_error_m for match in result.matches) < 0.06
    assert max(abs(match.radius_error_m) for match in result.matches) < 0.015
    error = ate(read_trajectory(out / "trajectory.txt"), read_trajectory(sequence / "groundtruth.txt"))
    assert error.rmse_m < 0.03
    targets = (out / "targets.jsonl").read_text().splitlines()
    assert sum('"status": "tracking"' in line for line in targets) > 0.3 * len(targets)
    assert np.isfinite(error.rotation_deg_max)
