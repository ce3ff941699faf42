"""Where the peers' environment cannot be made, nothing is said of them: exit 3, never a false figure."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from services.common.errors import GoalNotReachedError
from services.evaluate.bench import BenchOptions
from services.evaluate.bench_peers import PeerCloud, environment, with_sheet


def test_without_an_environment_it_is_not_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("venv.create", lambda folder, **_: Path(folder).mkdir(parents=True))
    said = subprocess.CompletedProcess(
        [], 1, "", "WARNING: slow\nERROR: No matching distribution found for dendromatics\n"
    )
    monkeypatch.setattr("subprocess.run", lambda *_, **__: said)
    with pytest.raises(GoalNotReachedError, match=r"not measured: pip cannot install .*No matching distribution"):
        environment(BenchOptions(out=tmp_path))
    assert not list(tmp_path.rglob("complete")), "the next call tries again"


def test_no_place_for_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(GoalNotReachedError, match="not measured: the peers' environment"):
        environment(BenchOptions(out=tmp_path))


def test_the_command_ends_with_three(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from services.cli.app import invoke

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert invoke(["bench", "peers", "--out", str(tmp_path / "out")]) == 3


def test_a_sheet_of_ground_only_where_there_is_none() -> None:
    points = np.random.default_rng(0).uniform([0, 0, 2], [1, 1, 5], (1000, 3))
    assert with_sheet(PeerCloud("c", points, ())) is points
    sheet = with_sheet(PeerCloud("c", points, (), groundless=True))[1000:]
    assert sheet[:, 2] == pytest.approx(points[:, 2].min(), abs=0.06)
    assert len(sheet) > 3000
