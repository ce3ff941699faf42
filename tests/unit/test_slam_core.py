"""slam as a whole on exact synthetic frames: turns, loops, blackout, gravity, the map's bookkeeping."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import exp_rotation, inverse, level_camera, log_rotation
from services.slam import gravity, vocabulary
from services.slam.config import SlamConfig
from services.slam.results import TrackResult
from services.slam.slam import Slam
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot

F64 = NDArray[np.float64]
CONFIG = SlamConfig(features=400, disparity_sigma_px=0.15)
UP_FORCE = np.array([0.0, -9.81, 0.0])
PERIOD_NS = 66_666_667


def run(poses: list[F64], slam: Slam | None = None, accel: F64 | None = UP_FORCE) -> tuple[Slam, list[TrackResult]]:
    slam = slam or Slam(INTRINSICS, CONFIG)
    return slam, [slam.track(k * PERIOD_NS, *look(T), accel) for k, T in enumerate(poses)]


def errors(found: list[F64], truth: list[F64]) -> tuple[float, float]:
    """Return the greatest position (m) and rotation (rad) error, first poses laid upon each other."""
    worst_m, worst_rad = 0.0, 0.0
    for T, true in zip(found, truth, strict=True):
        D = inverse(inverse(truth[0]) @ true) @ inverse(found[0]) @ T
        worst_m = max(worst_m, float(np.linalg.norm(D[:3, 3])))
        worst_rad = max(worst_rad, float(np.linalg.norm(log_rotation(D[:3, :3]))))
    return worst_m, worst_rad


def check_bookkeeping(slam: Slam) -> None:
    """The invariant of services.slam.atlas, both ways."""
    points, kf = slam.atlas.points, slam.atlas.keyframes
    seen = {(int(k), int(i)): int(kf.point[k, i]) for k in slam.atlas.slots for i in np.flatnonzero(kf.point[k] >= 0)}
    recorded = {
        (int(points.frame[p, j]), int(points.feature[p, j])): int(p)
        for p in np.flatnonzero(points.n)
        for j in range(points.n[p])
    }
    assert seen == recorded


@pytest.fixture(scope="module")
def turn() -> tuple[Slam, list[TrackResult], list[F64]]:
    poses = turn_on_the_spot(80, 380.0)
    return *run(poses), poses


def test_a_turn_on_the_spot_is_held_and_closes(turn: tuple[Slam, list[TrackResult], list[F64]]) -> None:
    slam, results, poses = turn
    assert [r.status for r in results] == ["tracking"] * len(poses)
    slam.polish()
    metres, rad = errors([T for _, T in slam.final_trajectory()], poses)
    assert metres < 0.04
    assert np.degrees(rad) < 0.8


def test_the_map_is_consistent_after_loops_and_culling(turn: tuple[Slam, list[TrackResult], list[F64]]) -> None:
    check_bookkeeping(turn[0])
    assert len(turn[0].atlas.slots) > 1, "nothing was there to be culled"


def test_the_map_frame_is_upright_at_the_first_camera(turn: tuple[Slam, list[TrackResult], list[F64]]) -> None:
    first = turn[1][0].T_map_camera
    assert first is not None
    np.testing.assert_allclose(first, level_camera([0.0, 0.0, 0.0], 0.0), atol=1e-9)


def test_results_are_whole(turn: tuple[Slam, list[TrackResult], list[F64]]) -> None:
    slam, results, _ = turn
    keyframes = slam.keyframe_poses()
    for r in results:
        assert r.T_map_camera is not None
        assert r.covariance is not None
        assert r.keyframe_id is not None
        assert (np.linalg.eigvalsh(r.covariance) > 0.0).all()
        np.testing.assert_allclose(r.T_map_camera[:3, :3] @ r.T_map_camera[:3, :3].T, np.eye(3), atol=1e-9)
        slam.mapping.keyframe_pose(r.keyframe_id)
    versions = [r.graph_version for r in results]
    assert versions == sorted(versions)
    assert set(keyframes) <= {k.keyframe_id for r in results for k in r.new_keyframes}


def test_the_same_frames_give_the_same_bytes() -> None:
    poses = turn_on_the_spot(20, 60.0)
    runs = [np.stack([T for _, T in run(poses)[0].final_trajectory()]).tobytes() for _ in range(2)]
    assert runs[0] == runs[1]


def test_a_blackout_is_told_and_the_place_found_again() -> None:
    poses = turn_on_the_spot(30, 60.0)
    slam, _ = run(poses)
    dark = np.zeros((240, 320), np.uint8)
    lost = slam.track(100 * PERIOD_NS, dark, np.zeros((240, 320), np.float32))
    assert lost.status == "lost"
    assert lost.T_map_camera is None
    assert lost.covariance is None
    back = slam.track(130 * PERIOD_NS, *look(poses[3]))
    assert back.status == "tracking"
    assert back.T_map_camera is not None
    D = inverse(inverse(poses[0]) @ poses[3]) @ inverse(level_camera([0.0, 0.0, 0.0], 0.0)) @ back.T_map_camera
    assert np.linalg.norm(D[:3, 3]) < 0.04
    assert back.reset_counter != lost.reset_counter


def test_a_camera_at_rest_gives_time_for_the_whole_map() -> None:
    slam, period_ns = Slam(INTRINSICS, SlamConfig(features=300)), 66_666_667
    views = [look(T) for T in turn_on_the_spot(12, 30.0)]
    results = [slam.track(k * period_ns, *view) for k, view in enumerate([*views, *[views[-1]] * 70])]
    made = [k for k, r in enumerate(results) if r.new_keyframes]
    whole = [k for k, r in enumerate(results) if r.graph is not None and r.graph.reason == "full_ba"]
    assert len(whole) == 1, "once, and not again while nothing new comes"
    assert whole[0] - made[-1] == pytest.approx(2e9 / period_ns, abs=2)


def test_another_runs_keyframes_are_followed() -> None:
    views = [look(T) for T in turn_on_the_spot(24, 60.0)]

    def keyframes(config: SlamConfig, follow: tuple[int, ...] = (), without: int = -1) -> tuple[int, ...]:
        slam = Slam(INTRINSICS, config)
        slam.follow_keyframes(follow)
        results = [slam.track(k, *view) for k, view in enumerate(views) if k != without]
        return tuple(r.stamp_ns for r in results if r.new_keyframes)

    often, seldom = SlamConfig(features=300, keyframe_ratio=0.95), SlamConfig(features=300, keyframe_ratio=0.7)
    flown = keyframes(often)
    assert keyframes(seldom) != flown
    assert keyframes(seldom, flown) == flown
    lost = flown[2]
    assert keyframes(seldom, flown, without=lost) == (*flown[:2], lost + 1, *(k for k in flown[3:] if k > lost + 1))


def test_frames_without_depth_do_not_start_a_map() -> None:
    slam = Slam(INTRINSICS, CONFIG)
    grey, depth = look(turn_on_the_spot(1, 0.0)[0])
    assert slam.track(0, grey, np.zeros_like(depth)).status == "initialising"
    assert slam.track(1, grey, depth).status == "tracking"


def test_first_pose_takes_gravity_from_the_accelerometer() -> None:
    tilt = exp_rotation([0.3, 0.0, 0.1])
    up_camera = tilt.T @ np.array([0.0, -1.0, 0.0])
    T = gravity.first_pose(9.81 * up_camera)
    np.testing.assert_allclose(T[:3, :3] @ up_camera, [0.0, 0.0, 1.0], atol=1e-12)
    assert T[1, 2] == pytest.approx(0.0, abs=1e-12)
    assert T[0, 2] > 0.0
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_a_tilted_first_reading_is_put_right_and_told() -> None:
    poses = [level_camera([0.0, 0.0, 0.0], 0.014 * k) for k in range(40)]
    slam = Slam(INTRINSICS, CONFIG)
    results = []
    for k, T in enumerate(poses):
        accel = UP_FORCE + np.array([1.0, 0.0, 0.0]) if k == 0 else UP_FORCE
        results.append(slam.track(k * PERIOD_NS, *look(T), accel))
    assert results[-1].up_sigma_rad < results[0].up_sigma_rad
    assert results[-1].reset_counter == 1
    last = results[-1].T_map_camera
    assert last is not None
    assert np.degrees(np.arccos(-last[2, 1])) < 0.3
    assert sum(r.graph is not None and r.graph.reason == "full_ba" for r in results) <= 1


def test_vocabulary_loads_and_tells_images_apart() -> None:
    words = vocabulary.load()
    slam, _ = run(turn_on_the_spot(12, 120.0))
    kf = slam.atlas.keyframes
    bags = [words.bag(kf.desc[k, : kf.n[k]]) for k in slam.atlas.slots]
    assert all(weights.sum() == pytest.approx(1.0) for _, weights in bags)
    assert all((np.diff(index) > 0).all() for index, _ in bags)


def test_training_is_deterministic_and_complete() -> None:
    rng = np.random.default_rng(5)
    images = [rng.integers(0, 2**63, (60, 4), dtype=np.uint64) for _ in range(4)]
    a, b = (vocabulary.train(images, 3, 2, 9) for _ in range(2))
    np.testing.assert_array_equal(a.centre, b.centre)
    assert set(a.words(images[0])) <= set(range(9))


@pytest.mark.parametrize("dead", [np.zeros(3), np.full(3, np.nan), np.array([0.0, np.inf, 0.0])])
def test_a_dead_accelerometer_is_no_accelerometer(dead: F64) -> None:
    assert gravity.direction(dead) is None
    slam, results = run([np.eye(4)] * 2, accel=dead)
    assert results[-1].status == "tracking"
    assert slam.up_sigma_rad == gravity.SIGMA_UNKNOWN_RAD


def test_without_loops_a_lost_camera_finds_its_place_again_too() -> None:
    """As the second camera's slam runs."""
    slam = Slam(INTRINSICS, SlamConfig(features=500, loop_closing=False))
    views = [look(T) for T in turn_on_the_spot(20, 80.0)]
    for k, (grey, depth_m) in enumerate(views):
        assert slam.track(k * 66_000_000, grey, depth_m).status == "tracking"
    before = slam.reset_counter
    for k in range(20, 35):
        slam.track(k * 66_000_000, np.zeros_like(views[0][0]), np.zeros_like(views[0][1]))
    result = slam.track(35 * 66_000_000, *views[0])
    assert result.status == "tracking"
    assert result.reset_counter == before + 1


def test_where_the_camera_rests_the_last_pose_follows_the_adjusted_map(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(INTRINSICS, SlamConfig(features=500))
    shift = np.array([0.05, 0.0, 0.0])

    def adjusted(**_: object) -> None:
        atlas = slam.mapping.atlas
        atlas.keyframes.t[atlas.slots] -= atlas.keyframes.R[atlas.slots] @ shift
        atlas.points.pos[:] += shift
        slam.mapping.revision += 1

    monkeypatch.setattr(slam.mapping, "adjust_all", adjusted)
    poses = turn_on_the_spot(8, 20.0)
    told = [slam.track(k * 66_000_000, *look(T)) for k, T in enumerate(poses)]
    monkeypatch.setattr(slam._rest, "begins", lambda *_, **__: True)
    resting = slam.track(8 * 66_000_000, *look(poses[-1]))
    assert resting.T_map_camera is not None
    assert told[-1].T_map_camera is not None
    (*_, (_, final)) = slam.final_trajectory()
    assert final[:3, 3] - resting.T_map_camera[:3, 3] == pytest.approx(shift, abs=2e-3)
