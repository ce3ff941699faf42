from __future__ import annotations

import base64
import csv
import io
import json
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from schemas.trees import Tree
from services.common.errors import InputError
from services.common.geometry import level_camera
from services.evaluate import exports
from services.evaluate.atomic import prepare, write_files
from services.evaluate.top_view import top_view_svg

TREE = Tree(
    id=3, x_m=1.23456789, y_m=-2.0, z_m=-1.5, axis=(0.0, 0.6, 0.8), radius_m=0.1, radius_height_m=1.3,
    height_seen_m=2.0, sigma_xy_m=0.01, sigma_radius_m=0.002, arc_rad=1.5, confidence=0.9, observations=7,
    suitable=True,
)  # fmt: skip


def test_stamps_keep_every_nanosecond() -> None:
    assert exports.seconds_text(1305031102_175304000) == "1305031102.175304"
    assert exports.seconds_text(1305031102_175304001) == "1305031102.175304001"
    assert exports.seconds_text(5) == "0.000000005"


def test_a_trajectory_is_position_and_quaternion() -> None:
    lines = exports.trajectory_bytes([(10**9, level_camera((1.0, 2.0, 3.0), 0.0))]).decode().splitlines()
    assert lines[0].startswith("#")
    numbers = [float(v) for v in lines[1].split()]
    assert numbers[:4] == [1.0, 1.0, 2.0, 3.0]
    assert np.allclose(numbers[4:], [-0.5, 0.5, -0.5, 0.5])


def test_a_ply_holds_points_and_colours() -> None:
    points = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    data = exports.ply_bytes(points, np.array([[1, 2, 3], [255, 0, 9]], np.uint8))
    header, body = data.split(b"end_header\n")
    assert b"element vertex 2" in header
    table = np.frombuffer(body, [("p", "<f4", 3), ("c", "u1", 3)])
    assert np.array_equal(table["p"], points)
    assert table["c"].tolist() == [[1, 2, 3], [255, 0, 9]]
    assert b"element vertex 0" in exports.ply_bytes(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))


def test_trees_json_is_the_contract() -> None:
    body = json.loads(exports.trees_json([TREE], "map"))
    assert body["frame"] == "map"
    assert list(body["trees"][0]) == [
        "id", "x_m", "y_m", "z_m", "axis", "radius_m", "radius_height_m", "height_seen_m", "sigma_xy_m", "sigma_radius_m",
        "arc_rad", "confidence", "observations", "suitable",
    ]  # fmt: skip
    assert body["trees"][0]["x_m"] == 1.234568
    assert body["trees"][0]["axis"] == [0.0, 0.6, 0.8]
    assert json.loads(exports.trees_json([], "input")) == {"frame": "input", "trees": []}


def test_trees_are_ordered_by_id() -> None:
    first = TREE.model_copy(update={"id": 1})
    assert exports.trees_json([TREE, first], "map") == exports.trees_json([first, TREE], "map")


def test_csv_and_geojson_say_the_same() -> None:
    (row,) = csv.DictReader(io.StringIO(exports.trees_csv([TREE]).decode()))
    assert (row["id"], row["axis_z"], row["suitable"]) == ("3", "0.8", "true")
    (feature,) = json.loads(exports.trees_geojson([TREE], "map"))["features"]
    assert feature["geometry"]["coordinates"] == [float(row["x_m"]), float(row["y_m"]), float(row["z_m"])]
    assert feature["properties"]["radius_m"] == float(row["radius_m"])


def test_results_appear_whole_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    prepare(out)
    assert not out.parent.exists()
    write_files(out, {"a": b"1", "b": b"2"})
    (out / "other").write_text("kept")
    write_files(out, {"a": b"3"})
    assert {p.name: p.read_text() for p in out.iterdir()} == {"a": "3", "b": "2", "other": "kept"}
    with pytest.raises(TypeError):
        write_files(out, {"a": b"9", "b": "no bytes"})  # type: ignore[dict-item]
    assert (out / "a").read_text() == "3"
    assert [p.name for p in out.parent.iterdir()] == ["out"]


def test_results_go_into_the_present_folder_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for out in (Path(), Path(".."), tmp_path):
        prepare(out)
        write_files(out, {"a": b"1"})
        assert (out / "a").read_bytes() == b"1"
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    (tmp_path.parent / "a").unlink()


def test_the_folder_above_out_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Path] = []
    mkdir = Path.mkdir

    def noted(self: Path, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        made.append(self)
        mkdir(self, mode, parents, exist_ok)

    (tmp_path / "out").mkdir()
    monkeypatch.setattr(Path, "mkdir", noted)
    write_files(tmp_path / "out", {"a": b"1"})
    assert [path.parent for path in made] == [tmp_path / "out"], "above may be closed to this user, or another disk"


def test_an_out_with_an_impossible_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written: File name too long"):
        prepare(tmp_path / ("x" * 300))


def test_an_out_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "f").write_text("")
    with pytest.raises(InputError, match="is a file"):
        prepare(tmp_path / "f")
    with pytest.raises(InputError, match="no folder"):
        prepare(tmp_path / "f" / "deeper")


def test_the_top_view_shows_each_tree_and_survives_none() -> None:
    poses = [(i, level_camera((0.1 * i, 0.0, 0.0), 0.0)) for i in range(5)]
    points = np.random.default_rng(1).uniform(-2.0, 2.0, (1000, 3)).astype(np.float32)
    one, none = (top_view_svg(trees, poses, points) for trees in ([TREE], []))
    assert one.count("<circle") == none.count("<circle") + 1
    for svg in (one, none, top_view_svg([], []), top_view_svg([TREE] * 3, [], np.empty((0, 3), np.float32))):
        ET.fromstring(svg)
        width, height = (float(v) for v in svg.split('viewBox="')[1].split('"')[0].split()[2:])
        assert height <= width, "it fits a screen, whatever the path"
    assert "data:image/png" in one


def test_the_raster_is_a_png_with_the_points_where_they_are() -> None:
    import cv2

    poses = [(0, level_camera((0.0, 0.0, 0.0), 0.0)), (1, level_camera((4.0, 0.0, 0.0), 0.0))]
    svg = top_view_svg([], poses, np.array([[4.5, 0.5, 1.0]], np.float32))
    data = base64.b64decode(svg.split("base64,")[1].split('"')[0])
    image = np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))
    ((row, column),) = np.argwhere(image[..., -1] > 0)
    assert row < 0.1 * image.shape[0], "x is up the page"
    assert 0.4 * image.shape[1] < column < 0.5 * image.shape[1], "y is to the left"
