"""``treedock process`` on the real recordings: accuracy with a margin for other machines' roundings."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from services.cli.app import invoke
from services.evaluate.ate import ate, read_trajectory

DATA = Path(os.environ.get("TREEDOCK_DATA", Path(__file__).parents[3] / "shared" / "data"))


def recording(name: str) -> Path:
    """Return a recording's folder, or skip."""
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: set TREEDOCK_DATA to the folder of the real recordings")
    return folder


def shortened(folder: Path, into: Path, frames: int) -> Path:
    """Return a folder with the first frames of a recording; the images are linked, not copied."""
    into.mkdir()
    for name in ("rgb", "depth", "camera.json", "accelerometer.txt", "groundtruth.txt"):
        (into / name).symlink_to((folder / name).resolve())
    lines = (folder / "associations.txt").read_text().splitlines(keepends=True)
    (into / "associations.txt").write_text("".join(lines[:frames]))
    return into


@pytest.mark.parametrize(
    ("name", "frames", "limit_m"), [("tum_fr1_desk_15hz", 298, 0.04), ("tum_fr1_xyz_15hz", 160, 0.025)]
)
def test_the_camera_is_tracked_as_well_as_promised(name: str, frames: int, limit_m: float, tmp_path: Path) -> None:
    folder = shortened(recording(name), tmp_path / "s", frames)
    out = tmp_path / "out"
    assert invoke(["process", str(folder), "--out", str(out)]) == 0
    truth = read_trajectory(folder / "groundtruth.txt")
    for file in ("trajectory.txt", "trajectory_online.txt"):
        estimate = read_trajectory(out / file)
        assert len(estimate.stamps_ns) >= 0.985 * frames
        assert ate(estimate, truth).rmse_m <= limit_m
    values = json.loads((out / "metrics.json").read_text())
    assert values["frames"] == frames
    assert values["cloud_points"] > 10_000
    assert len((out / "targets.jsonl").read_text().splitlines()) == frames
    assert sum(tree["suitable"] for tree in json.loads((out / "trees.json").read_text())["trees"]) == 0
