"""A mission's report: written when it ends, once; it tells what happened and why."""

from __future__ import annotations

import math
import re
import tracemalloc
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.navigation import MissionState
from schemas.slam import Pose, Transform
from schemas.topics import MISSION_STATE, SLAM_POSE, TREES_LIST, TREES_TARGET
from schemas.trees import Target, TreeList
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.geometry import pose as matrix
from services.common.geometry import rotation_z
from services.common.memory import Hub
from services.evaluate.mission_report import Story, mission_report
from services.evaluate.sightings import SIGHTING, Sightings, sightings
from services.evaluate.timeline import timeline_svg
from services.recorder.chronicle import Chronicle
from services.recorder.chronicle import Path as FlownPath
from services.recorder.config import RecorderConfig
from services.recorder.service import build
from tests.examples import all_messages, submap, without_points

SECOND = 10**9


def example(kind: type) -> Any:
    return next(e for e in all_messages().values() if type(e) is kind)


def state(name: str, reason: str, seconds: float = 1.0, **more: object) -> MissionState:
    made: MissionState = example(MissionState).model_copy(
        update={"state": name, "reason": reason, "stamp_ns": round(seconds * SECOND), "target_tree_id": None, **more}
    )
    return made


def pose(seconds: float, x_m: float, map_id: str = "m") -> Pose:
    at = Transform(position_m=(x_m, 0.0, 1.5), quaternion_xyzw=(0.5, -0.5, 0.5, -0.5))
    made: Pose = example(Pose).model_copy(
        update={"stamp_ns": round(seconds * SECOND), "T_map_camera": at, "map_id": map_id}
    )
    return made


MISSION = (
    state("take_off", "start was commanded", 1.0),
    state("scan", "1.5 m reached", 6.0),
    state("approach", "tree 7 is the nearest unvisited suitable one", 20.0, target_tree_id=7, distance_m=3.2),
    state("docked", "0.95 m for 3 s", 30.0, target_tree_id=7, docked_count=1),
    state("landed", "on the ground", 40.0, docked_count=1),
)


def recorded(folder: Path, states: tuple[MissionState, ...], *, mcap: bool = True) -> list[Path]:
    hub = Hub(TreedockConfig(recorder=RecorderConfig(folder=folder, reserve_mb=0, mcap=mcap)))
    service = build(cast("Context", hub.context("recorder")))
    other = hub.context("navigator")
    other.publish(TREES_LIST, example(TreeList))
    for number, told in enumerate(states):
        other.publish(SLAM_POSE, pose(told.stamp_ns / SECOND, 0.2 * number))
        other.publish(TREES_TARGET, example(Target))
        for _ in range(3):
            other.publish(MISSION_STATE, told)
        hub.run()
    hub.stop()
    assert service.drain is None or service.drain.trouble == ""
    return sorted(folder.glob("*report*.html"))


def test_a_mission_that_ends_has_its_report_beside_the_recording(tmp_path: Path) -> None:
    (path,) = recorded(tmp_path, MISSION)
    page = path.read_text()
    for words in ("0.95 m for 3 s", "tree 7: tree 7 is the nearest", "landed", "1.5 m reached", "<b>1</b>"):
        assert words in page
    assert page.count("<td>start was commanded</td>") == 1, "a state that is repeated is one event"


def test_two_missions_are_two_reports_and_a_broken_one_is_told_at_the_stop(tmp_path: Path) -> None:
    second = tuple(s.model_copy(update={"stamp_ns": s.stamp_ns + 100 * SECOND}) for s in MISSION)
    assert len(recorded(tmp_path / "two", (*MISSION, *second))) == 2
    (path,) = recorded(tmp_path / "broken", MISSION[:2])
    assert "1.5 m reached" in path.read_text()
    assert recorded(tmp_path / "none", (state("idle", "waiting"),)) == []


def test_a_second_mission_that_is_cut_off_has_its_report_too(tmp_path: Path) -> None:
    second = (state("preflight", "start was commanded again", 103.0), state("approach", "on its way to 9", 104.0))
    _, path = recorded(tmp_path / "cut", (*MISSION, *second))
    page = path.read_text()
    assert "on its way to 9" in page
    assert "0.95 m for 3 s" not in page, "the first mission has its own report"
    assert len(recorded(tmp_path / "idle", (*MISSION, state("idle", "waiting", 103.0)))) == 1


def test_reports_alone_need_no_recording(tmp_path: Path) -> None:
    (path,) = recorded(tmp_path, MISSION, mcap=False)
    assert "0.95 m for 3 s" in path.read_text()
    assert list(tmp_path.glob("*.mcap")) == []


def test_hostile_words_stay_words() -> None:
    page = mission_report(Story(states=[state("hold", "<script>alert(1)</script>")])).decode()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


@pytest.mark.parametrize(
    "story", [Story(), Story(uav="uav1", states=list(MISSION)), Story(trees=example(TreeList).trees)]
)
def test_every_story_gives_a_whole_page(story: Story) -> None:
    page = mission_report(story).decode()
    body = page[page.index("<body>") : page.index("</body>") + 7]
    ET.fromstring(body.replace("&nbsp;", " "))


def test_the_page_says_how_it_ended_and_shows_it_over_time() -> None:
    targets = [
        example(Target).model_copy(update={"stamp_ns": round((20 + k) * SECOND), "range_m": 3.0 - 0.2 * k})
        for k in range(10)
    ]
    page = mission_report(
        Story(uav="uav1", states=list(MISSION), trees=example(TreeList).trees, seen=sightings(targets))
    ).decode()
    assert "Docked at 1 tree. Ended landed: on the ground." in page
    assert 'class="verdict good"' in page
    bars = re.findall(r'<rect x="([\d.]+)" y="20" width="([\d.]+)"[^>]*><title>(\w+)', page)
    assert [name for _, _, name in bars] == ["take", "scan", "approach", "docked"]
    ends = [float(x) + float(wide) for x, wide, _ in bars]
    assert [float(x) for x, _, _ in bars[1:]] == pytest.approx(ends[:-1], abs=0.2), "they follow one another"
    assert float(bars[1][1]) == pytest.approx(14 / 39 * (720 - 68), abs=0.2), "a second is as wide everywhere"
    assert "distance to the tree" in page
    tree = example(TreeList).trees[0]
    row = f"<td>{200 * tree.radius_m:.1f}</td><td>{200 * tree.sigma_radius_m:.1f}</td>"
    assert row in page, "diameter and its sigma"
    failed = mission_report(Story(states=[*MISSION[:2], state("failed", "no tree was found", 9.0)])).decode()
    assert 'class="verdict warn"' in failed


def tracked(count: int, hz: float, begin_s: float = 1.0, tree_id: int = 7) -> Sightings:
    """Return what was seen of one tree at a steady rate."""
    seen = np.zeros(count, SIGHTING)
    seen["stamp_ns"] = np.round((begin_s + np.arange(count) / hz) * SECOND)
    seen["tree_id"], seen["tracking"], seen["range_m"] = tree_id, True, 1.5 + np.sin(np.arange(count) / 50)
    return seen


def flown(seconds: float) -> list[MissionState]:
    return [MISSION[0].model_copy(update={"stamp_ns": round(s * SECOND)}) for s in (0.0, seconds)]


def distance_line(svg: str) -> list[tuple[str, float, float]]:
    (line,) = (p.attrib["d"] for p in ET.fromstring(svg).iter("path"))
    return [(a, float(x), float(y)) for a, x, y in re.findall(r"([ML])([\d.]+) ([\d.]+)", line)]


@settings(max_examples=30)
@given(st.integers(2, 20_000), st.floats(0.2, 30.0))
def test_the_distance_is_one_line_however_long_the_flight(count: int, hz: float) -> None:
    points = distance_line(timeline_svg(flown(2.0 + count / hz), tracked(count, hz)))
    assert [a for a, _, _ in points].count("M") == 1
    assert min(count, 1_400) <= len(points) <= 3_100
    end_px = 62 + (720 - 68) * (1.0 + (count - 1) / hz) / (2.0 + count / hz)
    assert points[-1][1] == pytest.approx(end_px, abs=0.1), "the end is there"


def test_the_distance_breaks_where_another_tree_is_tracked_or_none_for_a_while() -> None:
    parts = [tracked(9_000, 15.0), tracked(3_000, 15.0, 601.0, 8), tracked(3_000, 15.0, 802.0, 8)]
    points = distance_line(timeline_svg(flown(1100.0), np.concatenate(parts)))
    begun_px = [x for a, x, _ in points if a == "M"]
    assert begun_px == pytest.approx([62 + (720 - 68) * s / 1100.0 for s in (1.0, 601.0, 802.0)], abs=0.1)


@given(st.floats(0.3, 30.0), st.floats(0.0, 30.0))
def test_the_labels_of_the_distance_do_not_lie_on_each_other(near_m: float, more_m: float) -> None:
    seen = tracked(50, 15.0)
    seen["range_m"] = np.linspace(near_m, near_m + more_m, 50)
    svg = timeline_svg(flown(5.0), seen)
    labels = [(float(t.attrib["y"]), t.text) for t in ET.fromstring(svg).iter("text") if (t.text or "").endswith(" m")]
    assert np.diff(sorted(y for y, _ in labels)).min(initial=99.0) >= 12.0
    assert "1.00 m" in [text for _, text in labels], "the band is what matters"
    assert "0.85 to 1.00 m" in svg


def test_one_tree_is_one_tree() -> None:
    trees = example(TreeList).trees[:1]
    page = mission_report(Story(uav="uav1", states=list(MISSION), trees=trees)).decode()
    assert "<small>docked</small><b>1</b><small>tree</small>" in page
    assert "<small>tree</small><b>1</b>" in page
    assert "<small>docked</small><b>0</b><small>trees</small>" in mission_report(Story()).decode()


def test_both_plots_of_a_mission_count_from_its_begin() -> None:
    seen = tracked(300, 15.0, 21.0)
    page = mission_report(Story(uav="uav1", states=list(MISSION), seen=seen)).decode()
    assert "20.0 to 39.9 s" in page, "the mission began at 1 s"


def test_a_submap_that_the_graph_moved_keeps_its_points() -> None:
    chronicle = Chronicle("uav1")
    whole = submap()
    chronicle.hear(whole)
    before = chronicle.story().points_m
    chronicle.hear(without_points(whole, (10.0, 0.0, 0.0)))
    assert chronicle.story().points_m == pytest.approx(before + np.array([10.0, 0.0, 0.0]))
    chronicle.hear(without_points(whole, removed=True))
    assert len(chronicle.story().points_m) == 0
    chronicle.hear(without_points(whole))
    assert len(chronicle.story().points_m) == 0, "a place without points is nothing"


def test_another_map_begins_the_path_anew() -> None:
    chronicle = Chronicle("uav1")
    for number in range(5):
        chronicle.hear(pose(number, 0.1 * number))
    chronicle.hear(pose(6.0, 9.0, "other"))
    assert [T[0, 3] for _, T in chronicle.story().trajectory] == [9.0]


def test_another_mission_begins_the_path_anew_and_an_hour_of_them_is_not_piled_up() -> None:
    chronicle = Chronicle("uav1")
    for mission in range(3):
        for k in range(50):
            chronicle.hear(pose(100.0 * mission + 0.1 * k, 10.0 * mission + 0.1 * k))
        for told in MISSION:
            chronicle.hear(told.model_copy(update={"stamp_ns": told.stamp_ns + 100 * mission * SECOND}))
        if mission == 0:
            begun = len(chronicle.story().trajectory)
    chronicle.hear(state("preflight", "mission 4 ordered", 300.0))
    chronicle.hear(pose(301.0, 7.0))
    assert begun > 40
    assert [T[0, 3] for _, T in chronicle.story().trajectory] == [7.0]


def test_a_mission_of_too_many_states_still_ends_and_is_reported_once() -> None:
    chronicle = Chronicle("uav1")
    due = [chronicle.hear(state("scan", f"turn {k}", 0.1 * k)) for k in range(2_100)]
    due += [chronicle.hear(state("landed", "down", 300.0)) for _ in range(3)]
    assert [k for k, now in enumerate(due) if now] == [2_100]
    states = chronicle.story().states
    assert len(states) == 2_000
    assert (states[0].reason, states[-1].state) == ("turn 0", "landed")


def test_thinning_keeps_shape_and_ends() -> None:
    path = FlownPath()
    assert path.poses() == []
    for n in range(1000):
        path.add(n, matrix(np.eye(3), [0.001 * n, 0.0, 0.0]))
    kept = path.poses()
    assert kept[0][0] == 0
    assert kept[-1][0] == 999
    assert kept[-1][1][0, 3] == pytest.approx(0.999)
    assert 45 <= len(kept) <= 60
    for degrees in range(360):
        path.add(1000 + degrees, matrix(rotation_z(math.radians(degrees)), [0.999, 0.0, 0.0]))
    assert 32 <= len(path.poses()) - len(kept) <= 36


def test_a_day_of_missions_takes_the_room_of_the_longest() -> None:
    chronicle = Chronicle("uav1")

    def fly(mission: int) -> None:
        chronicle.hear(state("scan", "on", 200.0 * mission))
        for k in range(2000):
            seconds = 200.0 * mission + 0.06 * k
            chronicle.hear(pose(seconds, 0.05 * k))
            chronicle.hear(example(Target).model_copy(update={"stamp_ns": round(seconds * SECOND)}))
        chronicle.hear(state("landed", "down", 200.0 * mission + 160.0))

    fly(0)
    story = chronicle.story()
    assert (len(story.trajectory), len(story.seen)) == (2000, 2000)
    del story
    tracemalloc.start()
    for mission in range(1, 4):
        fly(mission)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(chronicle.story().trajectory) == 2000
    assert held < 100e3


TARGET: Target = example(Target)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1))
def test_whatever_decodes_is_heard(tree_id: int, stamp_ns: int) -> None:
    body = {**TARGET.model_dump(), "tree_id": tree_id, "stamp_ns": stamp_ns}
    chronicle = Chronicle("uav1")
    chronicle.hear(Target.model_validate(body))
    assert chronicle.story().seen["tree_id"].tolist() == [tree_id]
