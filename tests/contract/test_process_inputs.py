"""Bad input to ``treedock process``: exit 2, one line that names the file and the fault, nothing written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from services.camera.codecs import encode_depth
from services.cli.app import invoke
from services.evaluate import offline
from tests.camera_data import CAMERA, depth_image, write_tum
from tests.stub_chain import BUILDERS
from tests.unit.test_camera_sources import write_mcap


@pytest.fixture(autouse=True)
def _stub_chain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(offline, "default_builders", lambda: BUILDERS)


def _image(kind: str, index: int) -> Callable[[Path], Path]:
    return lambda folder: sorted((folder / kind).iterdir())[index]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-50])


def _small(path: Path) -> None:
    path.write_bytes(encode_depth(depth_image(0)[:16, :24], "png"))


def _json_without(field: str) -> Callable[[Path], None]:
    return lambda path: _write(path, json.dumps({k: v for k, v in CAMERA.items() if k != field}))


def _write(path: Path, text: str) -> None:
    path.write_text(text)


FAULTS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], None], str]] = {
    "missing image": (_image("rgb", 1), Path.unlink, "no such file"),
    "truncated colour": (_image("rgb", 1), _cut, "truncated JPEG"),
    "truncated depth": (_image("depth", 2), _cut, "truncated PNG"),
    "no image at all": (_image("rgb", 0), lambda path: _write(path, "hello"), "neither PNG nor JPEG"),
    "empty image": (_image("depth", 0), lambda path: _write(path, ""), "empty"),
    "wrong-size depth": (_image("depth", 1), _small, "24x16, expected 48x32"),
    "broken camera.json": (lambda folder: folder / "camera.json", lambda path: _write(path, "{"), "not JSON"),
    "camera.json without fx": (lambda folder: folder / "camera.json", _json_without("fx"), "fx missing"),
    "no camera.json": (lambda folder: folder / "camera.json", Path.unlink, "--camera"),
    "no rgb.txt": (lambda folder: folder / "rgb.txt", Path.unlink, "no such file"),
    "broken depth.txt": (lambda folder: folder / "depth.txt", lambda path: _write(path, "12 a b\n"), "3 fields"),
    "NaN in accelerometer.txt": (
        lambda folder: folder / "accelerometer.txt", lambda path: _write(path, "1 nan 0 0\n"), "finite",
    ),
}  # fmt: skip


def refused(arguments: list[str], out: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Run and return the one line of the refusal."""
    before = sorted(out.parent.rglob("*"))
    assert invoke(["process", *arguments, "--out", str(out)]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.strip().splitlines()) == 1, printed.err
    assert "Traceback" not in printed.err
    assert sorted(out.parent.rglob("*")) == before
    return printed.err


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_input_is_one_line_and_nothing_is_written(
    fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    find, spoil, word = FAULTS[fault]
    folder = write_tum(tmp_path / "sequence", 4)
    path = find(folder)
    spoil(path)
    line = refused([str(folder)], tmp_path / "out", capsys)
    assert path.name in line
    assert word in line


def test_an_empty_and_a_missing_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert "rgb.txt" in refused([str(tmp_path / "empty")], tmp_path / "out", capsys)
    assert "no such file or folder" in refused([str(tmp_path / "none")], tmp_path / "out", capsys)


def test_a_foreign_and_a_cut_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign = tmp_path / "a.mcap"
    foreign.write_text("hello")
    assert "a.mcap" in refused([str(foreign)], tmp_path / "out", capsys)
    cut = write_mcap(tmp_path / "cut.mcap", 3)
    cut.write_bytes(cut.read_bytes()[:-200])
    assert "cut.mcap: the recording is cut short after 3 frames" in refused([str(cut)], tmp_path / "out", capsys)
    assert invoke(["process", str(cut), "--out", str(tmp_path / "out"), "--skip-bad-frames"]) == 0


def test_a_config_typo_names_the_nearest_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "sequence", 2)
    typo = tmp_path / "typo.toml"
    typo.write_text("[camera]\nmax_rnge_m = 4.0\n")
    line = refused([str(folder), "--config", str(typo)], tmp_path / "out", capsys)
    assert "typo.toml" in line
    assert "max_range_m" in line


def test_an_out_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("mine")
    refused([str(write_tum(tmp_path / "sequence", 2))], tmp_path / "out", capsys)
    assert (tmp_path / "out").read_text() == "mine"


def test_earlier_results_survive_a_failed_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = write_tum(tmp_path / "sequence", 4), tmp_path / "out"
    assert invoke(["process", str(folder), "--out", str(out)]) == 0
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    capsys.readouterr()
    _cut(sorted((folder / "rgb").iterdir())[3])
    refused([str(folder)], out, capsys)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_skip_bad_frames_goes_on_and_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_tum(tmp_path / "sequence", 6)
    sorted((folder / "rgb").iterdir())[3].unlink()
    _small(sorted((folder / "depth").iterdir())[4])
    out = tmp_path / "out"
    assert invoke(["process", str(folder), "--out", str(out), "--skip-bad-frames", "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert (values["frames"], values["bad_frames"]) == (4, 2)
    assert values == json.loads((out / "metrics.json").read_text())
    assert len((out / "trajectory.txt").read_text().splitlines()) == 1 + 3


def test_all_results_are_written_and_no_trees_is_a_result(tmp_path: Path) -> None:
    folder, out = write_tum(tmp_path / "sequence", 4), tmp_path / "deep" / "out"
    assert invoke(["process", str(folder), "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "cloud.laz", "cloud.ply", "metrics.json", "report.html", "targets.jsonl", "trajectory.txt", "trajectory_online.txt",
        "trees.csv", "trees.geojson", "trees.gpkg", "trees.json",
    ]  # fmt: skip
    assert json.loads((out / "trees.json").read_text()) == {"frame": "map", "trees": []}
    assert [path.name for path in out.parent.iterdir()] == ["out"]


def test_missing_arguments_are_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["process"]) == 2
    assert "Traceback" not in capsys.readouterr().err
