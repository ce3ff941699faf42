from __future__ import annotations

import json
import os
import stat
import threading
from pathlib import Path

import numpy as np
import pytest

from services.cli.app import invoke
from services.common.geometry import level_camera
from services.evaluate.exports import Viewpoints, ply_bytes
from tests.unit.detector_clouds import Floats, facing, ground, trunk, with_depth_noise


@pytest.fixture
def forest(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    cloud = np.concatenate([ground(3.0), trunk(1.5, 0.0, 0.1, rng), trunk(-1.0, 1.0, 0.3, rng)])
    path = tmp_path / "forest.xyz"
    np.savetxt(path, cloud, fmt="%.4f")
    return path


def _save(path: Path, cloud: Floats) -> Path:
    np.savetxt(path, cloud, fmt="%.4f")
    return path


def test_writes_trees_json(forest: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "trees.json"
    assert invoke(["detect", str(forest), "--out", str(out), "--up", "0,0,1"]) == 0
    told = json.loads(out.read_text())
    assert told["frame"] == "input"
    assert [t["suitable"] for t in told["trees"]] == [False, True]
    keys = {
        "id",
        "x_m",
        "y_m",
        "z_m",
        "axis",
        "radius_m",
        "radius_height_m",
        "height_seen_m",
        "sigma_xy_m",
        "sigma_radius_m",
    }
    keys |= {"arc_rad", "confidence", "observations", "suitable"}
    assert all(set(t) == keys for t in told["trees"])
    assert "2 trees" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["forest.xyz", "trees.json"]


def test_json_on_stdout_finds_the_vertical(forest: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    swapped = _save(tmp_path / "swapped.xyz", np.loadtxt(forest)[:, [1, 2, 0]])
    assert invoke(["detect", str(swapped), "--json", "--explain"]) == 0
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert told["up"] == [0.0, 1.0, 0.0]
    assert len(told["trees"]) == 2
    assert isinstance(told["dropped"], list)
    assert "vertical 0,1,0" in said.err


def test_a_device_or_pipe_is_written_to_never_replaced(forest: Path, tmp_path: Path) -> None:
    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()), daemon=True)
    reader.start()
    assert invoke(["detect", str(forest), "--out", str(pipe)]) == 0
    reader.join(timeout=20.0)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert len(json.loads(read[0])["trees"]) == 2


def test_a_link_is_followed(forest: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert invoke(["detect", str(forest), "--out", str(tmp_path / "link")]) == 0
    assert (tmp_path / "link").is_symlink()
    assert len(json.loads((tmp_path / "real").read_text())["trees"]) == 2


@pytest.mark.parametrize("shift_m", [0.0, -12_345.0, 512_345.0])
def test_the_table_fits_80_columns_and_cuts_nothing(
    shift_m: float, forest: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shifted = _save(tmp_path / "shifted.xyz", np.loadtxt(forest) + np.array([shift_m, shift_m, 1500.0]))
    assert invoke(["detect", str(shifted), "--up", "0,0,1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert "…" not in "".join(lines)
    rows = [line.split() for line in lines if line.split() and line.split()[0] in {"1", "2"}]
    assert [row[0] for row in rows[-2:]] == ["1", "2"]
    assert any(row[-2:] == ["too", "thick"] for row in rows)


def test_no_trees_is_a_result(tmp_path: Path) -> None:
    out = tmp_path / "trees.json"
    assert invoke(["detect", str(_save(tmp_path / "flat.xyz", ground(2.0))), "--out", str(out)]) == 0
    assert json.loads(out.read_text()) == {"frame": "input", "trees": []}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{}/none.ply"], "no such file"), (["{}/cut.pcd"], "cut short"), (["{}/nan.xyz"], "NaN"),
        (["{}/good.xyz", "--up", "0,0"], "--up"), (["{}/good.xyz", "--up", "0,0,0"], "--up"),
        (["{}/good.xyz", "--method", "magic"], "magic"), (["{}/good.xyz", "--out", "{}/no/trees.json"], "does not exist"),
        (["{}/good.xyz", "--out", "{}"], "is a folder"), (["{}/good.xyz", "--out", "{}/" + "x" * 300], "too long"),
        (["{}/good.xyz", "--out", "/dev/full"], "/dev/full: cannot be written: No space left"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_2(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _save(tmp_path / "good.xyz", ground(1.0))
    _save(tmp_path / "nan.xyz", np.full((100, 3), np.nan))
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 100\nHEIGHT 1\nPOINTS 100\nDATA binary\n"
    (tmp_path / "cut.pcd").write_bytes(head.encode() + bytes(500))
    before = sorted(p.name for p in tmp_path.iterdir())
    assert invoke(["detect", *(a.format(tmp_path) for a in arguments)]) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == before, "something half-written was left"


def test_other_units_are_noticed_and_named(forest: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for unit, scale in (("millimetres", 1000.0), ("centimetres", 100.0)):
        path = _save(tmp_path / f"{unit}.xyz", np.loadtxt(forest) * scale)
        assert invoke(["detect", str(path), "--json"]) == 0
        said = capsys.readouterr()
        told = json.loads(said.out)
        assert sorted(round(t["radius_m"], 1) for t in told["trees"]) == [0.1, 0.3]
        assert f"look like {unit}, not metres" in told["note"]
        assert f"look like {unit}" in said.err
    feet = _save(tmp_path / "feet.xyz", np.loadtxt(forest) / 0.3048)
    assert invoke(["detect", str(feet), "--units", "ft", "--json"]) == 0
    assert sorted(round(t["radius_m"], 1) for t in json.loads(capsys.readouterr().out)["trees"]) == [0.1, 0.3]
    assert invoke(["detect", str(feet), "--units", "yards"]) == 2


def test_pictures_and_trees_of_their_own(forest: Path, tmp_path: Path) -> None:
    import laspy

    drawn, trees = tmp_path / "drawn", tmp_path / "trees"
    arguments = ["detect", str(forest), "--up", "0,0,1", "--pictures", str(drawn), "--export-trees", str(trees)]
    assert invoke(arguments) == 0
    assert {"kept-001.png", "kept-002.png"} <= {p.name for p in drawn.iterdir()}
    assert sorted(p.name for p in trees.iterdir()) == ["tree-001.laz", "tree-002.laz"]
    las = laspy.read(trees / "tree-002.laz")
    tree = np.asarray(las.classification) == 5
    assert np.count_nonzero(tree) > 300
    xyz = np.asarray(las.xyz)
    assert np.hypot(xyz[tree, 0] - 1.5, xyz[tree, 1]).max() < 0.25
    assert np.abs(xyz[~tree, 2]).max() < 0.25
    assert np.hypot(xyz[~tree, 0] - 1.5, xyz[~tree, 1]).max() == pytest.approx(1.5, abs=0.1)


def test_why_there_are_none_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    scene = np.concatenate([ground(3.0), trunk(1.5, 0.0, 0.1, rng, height=0.7)])
    assert invoke(["detect", str(_save(tmp_path / "stump.xyz", scene)), "--up", "0,0,1"]) == 0
    said = capsys.readouterr().err
    assert "no candidates" in said or "dropped:" in said


def test_our_own_cloud_brings_its_views(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(2)
    eye = level_camera([0.0, 0.0, 1.5], 0.0)
    parts = [trunk(x, y, r, rng, arc=facing(x, y), density=6000.0) for x, y, r in ((3.0, 0.0, 0.1), (4.0, 1.5, 0.15))]
    cloud = with_depth_noise(np.concatenate([ground(5.0), *parts]), eye[:3, 3], rng)
    seen = Viewpoints(np.zeros(len(cloud), dtype=np.uint16), eye[None])
    (tmp_path / "cloud.ply").write_bytes(ply_bytes(cloud.astype(np.float32), np.zeros((0, 3), np.uint8), seen))
    assert invoke(["detect", str(tmp_path / "cloud.ply"), "--json"]) == 0
    said = capsys.readouterr()
    assert "as treedock wrote it" in said.err
    radii = sorted(t["radius_m"] for t in json.loads(said.out)["trees"])
    assert radii == pytest.approx([0.1, 0.15], abs=0.008)
