"""The viewer: every message with a picture is shown; without the library one line says how to get it."""

from __future__ import annotations

import sys
from collections import Counter
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from services.cli.app import invoke
from services.view.rerun_scene import Scene
from tests.examples import all_messages, submap, without_points


class Recorder(ModuleType):
    """Stands for rerun: an optional package that is not installed where the tests run."""

    def __init__(self) -> None:
        super().__init__("rerun")
        self.logged: Counter[str] = Counter()
        self.times: list[Any] = []
        self.ViewCoordinates = SimpleNamespace(RIGHT_HAND_Z_UP="z-up", RDF="rdf")

    def __getattr__(self, name: str) -> Any:
        if not name[0].isupper():
            raise AttributeError(name)
        return lambda *_, **__: SimpleNamespace(kind=name, compress=lambda **_: name)

    def log(self, entity: str, what: Any, **_: Any) -> None:
        assert what is not None
        self.logged[entity] += 1

    def set_time(self, timeline: str, **more: Any) -> None:
        self.times.append((timeline, more["timestamp"]))


def test_every_message_with_a_picture_is_shown() -> None:
    rerun = Recorder()
    scene = Scene(rerun, object())
    for message in all_messages().values():
        scene.show(message)
    assert {"map", "map/camera", "map/camera/image", "map/cloud/5", "map/trees", "target/range_m", "log"} <= set(
        rerun.logged
    )
    assert scene.shown == 7
    assert all(timeline == "stamp" for timeline, _ in rerun.times)


def test_a_submap_that_the_graph_moved_keeps_its_points() -> None:
    rerun, whole = Recorder(), submap()
    scene = Scene(rerun, object())
    scene.show(whole)
    logged = rerun.logged["map/cloud/5"]
    scene.show(without_points(whole, (1.0, 0.0, 0.0)))
    assert rerun.logged["map/cloud/5"] == logged + 1, "a new place, and no empty cloud over the old points"


def test_the_lens_is_told_once_and_a_new_map_clears_the_old() -> None:
    rerun = Recorder()
    scene = Scene(rerun, object())
    pose = next(m for m in all_messages().values() if type(m).__name__ == "Pose")
    for map_id in ("a", "a", "b"):
        scene.show(pose.model_copy(update={"map_id": map_id}))  # type: ignore[attr-defined]
    assert rerun.logged["map/cloud"] == 2


def test_without_rerun_one_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert invoke(["view", "x.mcap"]) == 2
    assert "pip install rerun-sdk" in capsys.readouterr().err
