from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.camera import RgbdFrame
from services.camera.calibration.board import Board
from services.camera.codecs import encode_colour, encode_depth
from services.camera.sources.camera_json import read_camera
from services.camera.sources.mcap_file import FrameWriter
from services.cli.app import invoke
from tests.board_views import SIZE, Grey, K, board_at, good_views, render
from tests.camera_data import INTRINSICS


@pytest.fixture(scope="module")
def images() -> list[Grey]:
    return list(good_views("checkerboard"))


@pytest.fixture
def folder(tmp_path: Path, images: list[Grey]) -> Path:
    place = tmp_path / "pictures"
    place.mkdir()
    for k, image in enumerate(images):
        cv2.imwrite(str(place / f"{k:02d}.png"), image)
    return place


def test_a_folder_of_pictures_gives_a_camera_file(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.json"
    (folder / "90.png").write_bytes((folder / "00.png").read_bytes()[:500])
    cv2.imwrite(str(folder / "91.png"), np.zeros((100, 100), np.uint8))
    cv2.imwrite(str(folder / "92.png"), np.zeros((SIZE[1], SIZE[0]), np.uint8))
    assert invoke(["calibrate", str(folder), "--out", str(out), "--json", "--depth-scale", "5000"]) == 0
    printed = capsys.readouterr()
    values = json.loads(printed.out)
    assert values["passed"]
    assert values["used"] == 12
    assert values["pictures"] == 15
    assert set(values["faults"]) == {"90.png", "91.png", "92.png"}
    assert "12/15 11.png: board found" in printed.err
    camera = read_camera(out).intrinsics
    assert (camera.width, camera.height, camera.depth_scale) == (*SIZE, 5000.0)
    assert camera.fx == pytest.approx(K[0, 0], rel=0.003)
    assert (tmp_path / "camera-residuals.png").exists()


def test_a_bad_set_is_refused_with_3_and_writes_no_camera(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.json"
    few = [str(path) for path in sorted(folder.iterdir())[:6]]
    assert invoke(["calibrate", *few, "--out", str(out)]) == 3
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("treedock: no calibration: only 6 of 6 pictures can be used, 8 are needed")
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ([], "name pictures of the board"),
        (["none"], "no such file"),
        ([".", "--board", "9by7"], "--board 9by7: expected inner corners"),
        ([".", "--board", "2x7"], "--board 2x7"),
        ([".", "--charuco", "--dictionary", "nonsense"], "--dictionary nonsense"),
        ([".", "--mount-image", "x.png"], "--mount-board"),
        (["--live"], "--source realsense"),
        (["--live", "--source", "tum:none"], "no such folder"),
    ],
)
def test_bad_usage_is_one_line(
    arguments: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert invoke(["calibrate", *arguments]) == 2
    err = capsys.readouterr().err.strip()
    assert word in err
    assert len(err.splitlines()) == 1


def test_a_folder_without_pictures_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["calibrate", str(tmp_path)]) == 2
    assert "no pictures" in capsys.readouterr().err


def test_live_pictures_are_taken_with_hints(
    tmp_path: Path, images: list[Grey], capsys: pytest.CaptureFixture[str]
) -> None:
    camera = INTRINSICS.model_copy(update={"width": SIZE[0], "height": SIZE[1], "cx": 240.0, "cy": 180.0, "fx": 400.0})
    depth = encode_depth(np.full((SIZE[1], SIZE[0]), 5000, np.uint16), "z16")
    path = tmp_path / "a.mcap"
    with FrameWriter(path, colour="bgr8") as writer:
        for k, image in enumerate([images[0], *images]):
            colour = encode_colour(np.repeat(image[:, :, None], 3, axis=2), "bgr8")
            writer.add(RgbdFrame(k * 10**8, k, camera, colour, depth))
    out = tmp_path / "camera.json"
    code = invoke(["calibrate", "--live", "--source", f"mcap:{path}", "--out", str(out), "--json"])
    printed = capsys.readouterr()
    values = json.loads(printed.out)
    assert "picture 1 taken; hold the board at the" in printed.err
    assert values["pictures"] <= 12, "the first picture twice adds nothing"
    assert code == 3, "a live set wants 15 pictures, this recording has 12"
    assert "15 are needed" in values["reasons"][0]


def test_the_mounting_is_written_and_the_same_pictures_give_the_same_bytes(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mount = tmp_path / "mount.png"
    cv2.imwrite(str(mount), render(Board(), board_at(0.0, 0.0, 0.4), 5))
    more = ["--mount-image", str(mount), "--mount-board", "0.5,0,0"]
    for name in ("a", "b"):
        assert invoke(["calibrate", str(folder), "--out", str(tmp_path / name / "c.json"), *more]) == 0
    text = capsys.readouterr().out
    assert "autopilot.camera_offset_m=[0.1" in text or "autopilot.camera_offset_m=[0.09" in text
    T = read_camera(tmp_path / "a" / "c.json").T_body_camera
    assert T is not None
    assert T[:3, 3] == pytest.approx([0.1, 0.0, 0.0], abs=0.004)
    for name in ("c.json", "c-residuals.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_board_can_be_printed_and_is_found(tmp_path: Path) -> None:
    from services.camera.calibration.board import find_board

    for kind in ([], ["--charuco"]):
        path = tmp_path / "board.png"
        assert invoke(["calibrate", "--print-board", str(path), *kind]) == 0
        picture = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        assert find_board(picture, Board(kind="charuco" if kind else "checkerboard")) is not None
