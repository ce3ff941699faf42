"""Mapping beside tracking: turns are kept, faults are told, and the map stays whole."""

from __future__ import annotations

import queue
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.common.context import HealthBook
from services.common.geometry import exp_rotation
from services.slam.bundle import adjust
from services.slam.config import SlamConfig
from services.slam.mapping import Mapping
from services.slam.maps import LiveMaps
from services.slam.slam import Slam
from services.slam.worker import Beside
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot
from tests.unit.test_slam_core import check_bookkeeping, errors

CONFIG = SlamConfig(features=300, disparity_sigma_px=0.15, relocalise_within_s=0.3, new_map_after_s=0.5)
PERIOD_NS = 66_666_667
DARK = np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.float32)


def settle(crew: Beside) -> None:
    end_s = time.monotonic() + 30.0
    while not crew.idle and time.monotonic() < end_s:
        time.sleep(0.005)
    assert crew.idle


def test_frames_and_steps_never_overlap_and_a_frame_goes_first() -> None:
    crew = Beside()
    inside: list[str] = []
    overlaps: list[list[str]] = []
    begun = threading.Event()

    def enter(who: str) -> None:
        inside.append(who)
        if len(inside) > 1:
            overlaps.append(list(inside))
        time.sleep(0.001)
        inside.remove(who)

    def job() -> None:
        for _ in range(60):
            with crew.step():
                begun.set()
                with crew.step():  # a step within a step is the same one
                    enter("step")

    crew.submit(job)
    assert begun.wait(5.0)
    waits = []
    for _ in range(20):
        asked = time.monotonic()
        with crew.frame():
            waits.append(time.monotonic() - asked)
            enter("frame")
    settle(crew)
    crew.close()
    assert not overlaps
    assert np.median(waits) < 0.02, "a frame waits for one step, not for the job"


def test_a_failed_job_is_raised_by_the_next_frame() -> None:
    crew = Beside()

    def job() -> None:
        raise ValueError("on purpose")

    crew.submit(job)
    with pytest.raises(RuntimeError, match="mapping failed"):  # noqa: PT012 - until the job was reached
        for _ in range(500):
            with crew.frame():
                time.sleep(0.01)


def test_closing_does_not_wait_for_a_job_that_the_thread_has_just_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    crew = Beside()

    class Taken(queue.SimpleQueue[Any]):
        def empty(self) -> bool:  # as it was a moment ago
            return False

    monkeypatch.setattr(crew, "_jobs", Taken())
    closing = threading.Thread(target=crew.close, daemon=True)
    closing.start()
    closing.join(5.0)
    assert not closing.is_alive()


def test_a_frame_waits_for_mapping_that_has_fallen_behind() -> None:
    crew, go = Beside(), threading.Event()

    def job() -> None:
        go.wait(30.0)

    crew.submit(job)
    crew.submit(job)
    assert not crew.keep_up(), "two keyframes may be on their way"
    crew.submit(lambda: None)
    begin_s = time.monotonic()
    assert crew.keep_up()
    assert time.monotonic() - begin_s > 0.3, "it waits"
    with crew.frame():
        pass  # and the frame is taken all the same: nobody flies blind because mapping hangs
    go.set()
    settle(crew)
    assert not crew.keep_up()
    crew.close()


def test_a_turn_is_held_and_closed_with_mapping_beside_tracking() -> None:
    crew = Beside()
    slam = Slam(INTRINSICS, CONFIG, crew=crew)
    poses = turn_on_the_spot(80, 380.0)
    results = []
    for k, T in enumerate(poses):
        results.append(slam.track(k * PERIOD_NS, *look(T), np.array([0.0, -9.81, 0.0])))
        if k % 10 == 9:
            settle(crew)
    settle(crew)
    slam.polish()
    settle(crew)
    graph = slam.catch_up()
    crew.close()
    assert [r.status for r in results] == ["tracking"] * len(poses)
    versions = [r.graph_version for r in results]
    assert versions == sorted(versions)
    told = [r.graph.version for r in results if r.graph is not None]
    assert told == sorted(set(told))
    assert graph is None or graph.reason == "full_ba"
    check_bookkeeping(slam)
    living = slam.keyframe_poses()
    made = {new.keyframe_id: k for k, r in enumerate(results) for new in r.new_keyframes if new.keyframe_id in living}
    metres, rad = errors([living[serial] for serial in made], [poses[k] for k in made.values()])
    assert len(made) > 10
    assert metres < 0.05
    assert np.degrees(rad) < 1.0
    metres, _ = errors([T for _, T in slam.final_trajectory()], poses)
    assert metres < 0.12, "frames seen between a loop's graph and its adjustment are no worse than before the loop"


def test_an_adjustment_is_not_lost_when_the_map_is_turned_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    def mapped() -> Slam:
        slam = Slam(INTRINSICS, CONFIG.model_copy(update={"loop_closing": False}))
        for k, T in enumerate(turn_on_the_spot(12, 55.0)):
            slam.track(k * PERIOD_NS, *look(T))
        rng = np.random.default_rng(3)
        slam.atlas.keyframes.t[slam.atlas.slots[1:]] += rng.normal(0.0, 0.01, (len(slam.atlas.slots) - 1, 3))
        return slam

    R = exp_rotation(np.array([0.02, -0.03, 0.01]))
    still, turned = mapped(), mapped()
    before = still.keyframe_poses()
    still.mapping.adjust_all()

    def turning(*args: Any) -> float:
        cost = adjust(*args)
        if not turned.mapping.turns:
            turned.mapping.turn(R)
        return cost

    monkeypatch.setattr("services.slam.mapping.adjust", turning)
    turned.mapping.adjust_all()
    assert len(before) > 3
    for serial, T in still.keyframe_poses().items():
        there = turned.keyframe_poses()[serial]
        np.testing.assert_allclose(there[:3, :3], R @ T[:3, :3], atol=1e-9)
        np.testing.assert_allclose(there[:3, 3], R @ T[:3, 3], atol=1e-9)
        assert serial == 0 or np.linalg.norm(T[:3, 3] - before[serial][:3, 3]) > 1e-4, "it moved something"
    used = np.flatnonzero(still.atlas.points.n)
    np.testing.assert_allclose(turned.atlas.points.pos[used], still.atlas.points.pos[used] @ R.T, atol=1e-6)


def test_lost_for_long_a_new_map_is_begun_and_told(tmp_path: Path) -> None:
    health = HealthBook()
    maps = LiveMaps(CONFIG, tmp_path, health)
    slam = first = maps.begin(INTRINSICS, 0)
    seen = look(turn_on_the_spot(1, 0.0)[0])
    images = [seen] * 3 + [DARK] * 10 + [seen]
    statuses = []
    for k, image in enumerate(images):
        result = slam.track(k * PERIOD_NS, *image)
        statuses.append((slam.map_id, result.status))
        slam = maps.after(slam, result)
    maps.end()
    assert slam is not first
    lost = [k for k, (map_id, status) in enumerate(statuses) if (map_id, status) == (first.map_id, "lost")]
    assert len(lost) == 9, "0.5 s at 15 Hz, the first of them the beginning"
    assert statuses[-1] == (slam.map_id, "tracking")
    assert first.map_id in health.notes["map"]
    assert slam.map_id in health.notes["map"]
    assert health.counters["maps_begun"] == 2


def test_a_map_taken_up_in_vain_is_given_up_after_the_stated_time(tmp_path: Path) -> None:
    maps = LiveMaps(CONFIG, tmp_path, HealthBook())
    slam = maps.begin(INTRINSICS, 0)
    slam.track(0, *look(turn_on_the_spot(1, 0.0)[0]))
    settle_all(maps)
    health = HealthBook()
    again = LiveMaps(CONFIG, tmp_path, health)  # the first was killed
    old = again.begin(INTRINSICS, 10**9)
    assert old.map_id == slam.map_id
    assert old.map_id in health.notes["map"]
    current, statuses = old, []
    for k in range(8):
        result = current.track(10**9 + k * PERIOD_NS, *DARK)
        statuses.append((current.map_id == slam.map_id, result.status))
        current = again.after(current, result)
    again.end()
    maps.end()
    assert statuses[:6] == [(True, "relocalising")] * 6
    assert statuses[6:] == [(False, "initialising")] * 2
    assert "given up" in health.notes["map"]


def test_a_stopped_slam_leaves_no_map_behind(tmp_path: Path) -> None:
    maps = LiveMaps(CONFIG, tmp_path, HealthBook())
    maps.begin(INTRINSICS, 0).track(0, *look(turn_on_the_spot(1, 0.0)[0]))
    settle_all(maps)
    assert list(tmp_path.iterdir())
    maps.end()
    assert not list(tmp_path.iterdir())


def settle_all(maps: LiveMaps) -> None:
    crew = maps.crew
    assert isinstance(crew, Beside)
    settle(crew)


def test_a_large_adjustment_gives_way_to_a_keyframe_and_is_made_up_for(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(INTRINSICS, CONFIG)
    for k, T in enumerate(turn_on_the_spot(30, 130.0)):
        slam.track(k * PERIOD_NS, *look(T))
    monkeypatch.setattr("services.slam.mapping._COMPILED_KEYFRAMES", 1)
    seen = slam.atlas.points.n.sum()
    busy = True
    monkeypatch.setattr(type(slam.mapping), "hurried", lambda _: busy)
    slam.mapping.adjust_all()
    assert slam.atlas.points.n.sum() == seen, "nothing is thrown away by an adjustment that did not come to its end"
    busy = False
    revision = slam.mapping.revision
    slam.mapping.settle(int(slam.atlas.slots[-1]))
    assert slam.mapping.revision == revision + 2, "the window's adjustment, and the one that was owed"
    check_bookkeeping(slam)


def test_where_keyframes_never_cease_a_large_adjustment_is_tried_three_times(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(INTRINSICS, CONFIG)
    for k, T in enumerate(turn_on_the_spot(30, 130.0)):
        slam.track(k * PERIOD_NS, *look(T))
    monkeypatch.setattr("services.slam.mapping._COMPILED_KEYFRAMES", 1)
    busy, tries = False, 0
    whole = type(slam.mapping).adjust_all

    def interrupted(mapping: Mapping, *args: int) -> None:
        nonlocal busy, tries
        busy, tries = True, tries + 1
        whole(mapping, *args)
        busy = False

    monkeypatch.setattr(type(slam.mapping), "hurried", lambda _: busy)
    monkeypatch.setattr(type(slam.mapping), "adjust_all", interrupted)
    slam.mapping.owe()
    for _ in range(10):
        slam.mapping.pay(int(slam.atlas.slots[-1]))
    assert tries == 3
    assert not slam.mapping.owed


def test_what_has_fallen_behind_is_thinned_and_the_way_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = turn_on_the_spot(26, 52.0)
    counts = []
    for behind in (1000, 6):
        monkeypatch.setattr("services.slam.thinning._BEHIND", behind)
        slam = Slam(INTRINSICS, CONFIG.model_copy(update={"keyframe_ratio": 1.0}))  # a keyframe almost every frame
        results = [slam.track(k * PERIOD_NS, *look(T), np.array([0.0, -9.81, 0.0])) for k, T in enumerate(poses)]
        assert all(r.status == "tracking" for r in results)
        counts.append(len(slam.atlas.slots))
        check_bookkeeping(slam)
    assert counts[1] < counts[0]
    found = [T for _, T in slam.final_trajectory()]
    metres, rad = errors(found, poses)
    assert metres < 0.1, "frames between a loop's graph and its adjustment: no worse than before the loop (5 to 7 cm)"
    closed = [k for k, r in enumerate(results) if r.reset_counter == results[-1].reset_counter]
    before = [k for k in range(len(poses)) if k < 60]
    for part in (before, [0, *closed]):
        metres, rad = errors([found[k] for k in part], [poses[k] for k in part])
        assert metres < 0.05
        assert np.degrees(rad) < 1.0
