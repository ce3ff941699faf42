"""The same sequence gives the same bytes, in another process, with other hash seeds, without groundtruth.txt."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from services.evaluate.trees import read_trees, read_truth, score
from services.simulator.catalogue import random_scene
from services.simulator.write import write_sequence

RESULTS = (
    "trees.json",
    "trees.csv",
    "trees.geojson",
    "trees.gpkg",
    "cloud.laz",
    "trajectory.txt",
    "trajectory_online.txt",
    "cloud.ply",
    "targets.jsonl",
    "fine_cloud.laz",
    "trees_fine.json",
    "trees_fine.csv",
    "sections_fine.csv",
    "ground_fine.asc",
)


def process(sequence: Path, out: Path, hash_seed: str) -> None:
    environment = {**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"}
    command = [
        sys.executable,
        "-m",
        "services.cli.app",
        "process",
        str(sequence),
        "--out",
        str(out),
        "--json",
        "--fine",
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["frames"] > 200


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_runs_give_the_same_bytes_and_groundtruth_changes_none(tmp_path: Path) -> None:
    sequence = tmp_path / "sequence"
    write_sequence(random_scene(31, "multi", trees=3), sequence, rate_hz=7.5, reduced=True)
    process(sequence, tmp_path / "a", "1")
    (sequence / "groundtruth.txt").unlink()
    truth = read_truth(sequence / "truth.json")
    (sequence / "truth.json").unlink()
    process(sequence, tmp_path / "b", "2")
    for name in RESULTS:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name
    result = score(read_trees(tmp_path / "a" / "trees.json"), truth)
    assert len(read_trees(tmp_path / "a" / "trees.json")) >= 3
    assert len(result.matches) >= 2
    finer = {tree["id"]: tree for tree in json.loads((tmp_path / "a" / "trees_fine.json").read_text())["trees"]}
    measured = [(match, finer[match.found.id]) for match in result.matches if match.found.id in finer]
    # the tree that the flight ends at is seen from near: its diameter is sure, the others' less so
    assert min(abs(stem["diameter_13_m"] - 2.0 * match.true.radius_m) for match, stem in measured) < 0.02
    assert all(len(stem["sections"]) >= 3 for _, stem in measured)
    assert "Finer map" in (tmp_path / "a" / "report.html").read_text()
