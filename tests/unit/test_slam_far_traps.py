"""Far points tell no place: not after an outage, not without a depth image, not to a lost camera, not at the start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import inverse, level_camera
from services.slam import movers
from services.slam.config import SlamConfig
from services.slam.relocation import Relocation
from services.slam.results import TrackResult
from services.slam.slam import Slam
from services.slam.tracking import Tracked
from tests.unit.slam_backdrop import BEYOND_MAP, CLOSED, OPEN
from tests.unit.slam_backdrop import look as look_out
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot
from tests.unit.test_slam_runaway import CONFIG

F64 = NDArray[np.float64]

PERIOD_NS = 66_666_667
S_NS = 10**9


class Watched:
    """A slam that looks out, and how far off the truth its poses are."""

    def __init__(self) -> None:
        self.slam = Slam(INTRINSICS, SlamConfig(features=600))
        self._noise = np.random.default_rng(1)
        self._frames = 0
        self._T_world_map: F64 = np.eye(4)

    def see(self, T: F64, planes: list, *, dark: bool = False, deep: bool = True, reach_m: float = 6.0) -> TrackResult:
        grey, depth_m = look_out(T, planes, self._noise, reach_m)
        result = self.slam.track(
            self._frames * PERIOD_NS, np.full_like(grey, 20) if dark else grey, depth_m if deep else 0.0 * depth_m
        )
        if self._frames == 0 and result.T_map_camera is not None:
            self._T_world_map = T @ inverse(result.T_map_camera)
        self._frames += 1
        return result

    def off_m(self, T: F64, result: TrackResult) -> float:
        assert result.T_map_camera is not None
        return float(np.linalg.norm((self._T_world_map @ result.T_map_camera)[:3, 3] - T[:3, 3]))


def sway(k: int, y_m: float = 0.0) -> F64:
    return level_camera([0.02 * np.sin(k), y_m + 0.03 * np.cos(0.7 * k), 0.0], 0.02 * np.sin(0.5 * k))


@pytest.mark.parametrize("way_m", [0.8, 0.9, 1.2])
def test_after_an_outage_far_points_alone_tell_no_place(way_m: float) -> None:
    """They agree best with a camera that stayed where it was: it was 1.1 to 1.6 m off, said to be known to 1 cm."""
    watched = Watched()
    for k in range(8):
        assert watched.see(sway(k), OPEN).status == "tracking"
    for k in range(12):
        watched.see(level_camera([0.0, -way_m * k / 12, 0.0], 0.0), OPEN, dark=True)
    for k in range(12):
        T = sway(k, -way_m)
        result = watched.see(T, OPEN)
        assert result.status == "lost" or watched.off_m(T, result) < 0.25


def test_without_a_depth_image_nothing_is_far() -> None:
    """No depth anywhere is a camera's fault; taken for 16 m everywhere, the pose stayed 2.3 m behind in 2.4 m."""
    watched = Watched()
    for k in range(70):
        T = level_camera([0.0, -0.04 * max(k - 8, 0), 0.0], 0.0)
        result = watched.see(T, CLOSED, deep=k < 10)
        if k >= 10:
            assert not watched.slam._last or not watched.slam._last.features.far.any()
        if result.T_map_camera is not None:
            assert result.covariance is not None
            sigma_m = float(np.sqrt(np.linalg.eigvalsh(result.covariance[:3, :3])[-1]))
            assert watched.off_m(T, result) < max(0.1, 4.0 * sigma_m)


def test_a_view_into_the_open_has_far_points() -> None:
    watched = Watched()
    watched.see(sway(0), OPEN)
    assert watched.slam._last is not None
    assert np.count_nonzero(watched.slam._last.features.far) > 100


def test_a_map_begins_with_depth_that_makes_points() -> None:
    watched = Watched()
    results = [watched.see(sway(k), BEYOND_MAP, reach_m=12.0) for k in range(3)]
    assert [r.status for r in results] == ["initialising"] * 3


@pytest.fixture
def lost() -> tuple[Slam, Relocation, tuple]:
    """Return a slam with a map, who relocates in it, and what it sees of it."""
    slam = Slam(INTRINSICS, CONFIG)
    poses = turn_on_the_spot(14, 60.0)
    for k, T in enumerate(poses):
        slam.track(k * PERIOD_NS, *look(T))
    grey, depth_m = look(poses[-1])
    return slam, Relocation(slam.loops, slam._verifier), (slam._extractor.extract(grey, depth_m), depth_m)


def with_close(frame: Tracked, close: int) -> Tracked:
    """Return the frame with all but so many of its matches beyond the range."""
    f = frame.features
    matched = np.flatnonzero(frame.point >= 0)[close:]
    depth, far = f.depth.copy(), f.far.copy()
    depth[matched], far[matched] = 0.0, True
    return replace(frame, features=replace(f, depth=depth, far=far), place=None)


@pytest.mark.parametrize(("close", "found"), [(19, False), (20, True)])
def test_a_lost_camera_finds_no_place_by_far_points_alone(
    close: int, found: bool, lost: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, relocation, seen = lost
    place = slam.loops.place
    monkeypatch.setattr(slam.loops, "place", lambda f, slot: (got := place(f, slot)) and with_close(got, close))
    assert (relocation.find(10**12, *seen) is not None) is found


def test_far_temporary_points_are_not_measured(lost: tuple) -> None:
    slam, _, _ = lost
    last = slam._last
    far = last.features.far
    far[:40] = True
    known = np.full(len(far), -1, np.int32)
    np.testing.assert_array_equal(slam.tracking._measured(known, last), ~far)


def unsure(frame: Tracked, off_m: float) -> Tracked:
    return replace(frame, t=frame.t + np.array([off_m, 0.0, 0.0]), inliers=60, expected=100, place=None)


def test_a_first_sight_vouches_for_half_a_second(lost: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    slam, relocation, seen = lost
    good = slam.loops.place(seen[0], int(slam.atlas.slots[-1]))

    def find(at_s: float, off_m: float) -> bool:
        monkeypatch.setattr(slam.loops, "place", lambda *_: unsure(good, off_m))
        return relocation.find(round(at_s * S_NS), *seen) is not None

    assert not find(1000.0, 0.0)
    assert not find(1060.0, 40.0), "a minute later it may be 40 m off"
    assert find(1060.4, 40.0)
    assert not find(1061.0, 40.0)
    relocation.forget()
    assert not find(1061.2, 40.0), "the camera was located meanwhile"


def test_a_located_frame_ends_what_a_lost_one_saw(lost: tuple) -> None:
    slam, _, _ = lost
    slam._relocation._found = (0, slam._last)
    assert slam.track(14 * PERIOD_NS, *look(turn_on_the_spot(14, 60.0)[-1])).status == "tracking"
    assert slam._relocation._found is None


def test_a_place_that_is_not_believed_hides_no_other(lost: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    slam, relocation, seen = lost
    place, tried = slam.loops.place, []

    def vague_at_first(features: object, slot: int) -> Tracked | None:
        tried.append(slot)
        found = place(features, slot)
        return found if len(tried) > 1 or found is None else replace(found, information=found.information * 1e-8)

    monkeypatch.setattr(slam.loops, "place", vague_at_first)
    assert relocation.find(10**12, *seen) is not None
    assert len(tried) > 1


def test_what_moves_may_leave_too_few_matches_for_a_pose(lost: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    slam, _, _ = lost

    def take_most(_: object, __: Tracked, frame: Tracked, ___: float) -> None:
        frame.point[np.flatnonzero(frame.point >= 0)[24:]] = -1
        frame.inliers = frame.expected = 24

    monkeypatch.setattr(movers, "mark", take_most)
    monkeypatch.setattr(slam._relocation, "find", lambda *_: None)
    assert slam.track(14 * PERIOD_NS, *look(turn_on_the_spot(14, 60.0)[-1])).status == "lost"


def test_the_frame_that_sees_a_loops_adjustment_sees_the_loop(lost: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """A frame between the adjustment and the end of the loop's job found no reason for its jump."""
    slam, _, _ = lost
    mapping, loops, told = slam.mapping, slam.loops, []
    adjust_all, pay, before = mapping.adjust_all, mapping.pay, loops.closed

    def adjusting(k: int) -> None:
        told.append(loops.closed)
        adjust_all(k)

    def paying(k: int) -> None:
        told.append(loops.closed)
        pay(k)

    monkeypatch.setattr(mapping, "adjust_all", adjusting)
    monkeypatch.setattr(mapping, "pay", paying)
    first, last = int(slam.atlas.slots[-3]), int(slam.atlas.slots[-1])
    found = loops.place(slam.atlas.features_of(last), first)
    assert found is not None
    loops.close(last, first, found, mapping.turned)
    assert told == [before + 2] * 2
    assert loops.closed == before + 2


@pytest.mark.parametrize("first", [True, False])
def test_only_the_first_keyframe_looks_along_the_maps_x(first: bool, lost: tuple) -> None:
    slam, _, _ = lost
    if not first:
        slam.atlas.keyframes.serial[slam.atlas.slots[0]] = 77
    assert (slam._first_forward() is not None) is first
