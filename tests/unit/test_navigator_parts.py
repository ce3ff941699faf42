"""The mission's parts: trajectory, track, path, docking window, selection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.slam import Pose
from services.common.geometry import camera_yaw, exp_rotation, level_camera, to_transform
from services.navigator.config import DockConfig, MotionConfig, NavigatorConfig
from services.navigator.docking import DockMonitor, DockSample
from services.navigator.path import Disc, clearance_m, line_clearance_m, plan, standoff
from services.navigator.selection import axis_at, choose
from services.navigator.track import Correction, PoseTrack, Step, correction_between
from services.navigator.trajectory import Aim, Fence, Trajectory
from tests.unit.navigator_world import tree

DT = 0.05
coordinate = st.floats(-8.0, 8.0)
point = st.tuples(coordinate, coordinate, st.floats(-1.0, 4.0))


# -- trajectory ---------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(point, st.floats(-7.0, 7.0), st.floats(0.0, 3.0)), min_size=1, max_size=5))
def test_trajectory_never_exceeds_its_limits(goals: list[tuple[tuple[float, float, float], float, float]]) -> None:
    limits = MotionConfig()
    t = Trajectory(limits)
    t.fence = Fence(np.zeros(3), -0.3, 5.0, 3.3)
    for position, yaw, speed in goals:
        for _ in range(60):
            before, yaw_before = t.position_m.copy(), t.yaw_rad
            velocity, accel = t.velocity_m_s.copy(), t.accel_m_s2.copy()
            t.advance(Aim(np.array(position), yaw, speed, 9.0), DT, None)
            assert np.linalg.norm(t.velocity_m_s) <= limits.max_speed_m_s + 1e-9
            assert abs(t.yaw_rate_rad_s) <= limits.max_yaw_rate_rad_s + 1e-9
            assert t.fence.excess_m(t.position_m) <= 1e-9
            assert np.allclose(t.position_m - before, t.velocity_m_s * DT, atol=1e-9)
            assert t.yaw_rad - yaw_before == pytest.approx(t.yaw_rate_rad_s * DT)
            at_the_fence = t.fence.excess_m(t.position_m + 0.05 * t.velocity_m_s) > 0.0 or not t.accel_m_s2.any()
            if not at_the_fence:
                assert np.linalg.norm(t.velocity_m_s - velocity) <= limits.max_accel_m_s2 * DT + 1e-9
                assert np.linalg.norm(t.accel_m_s2 - accel) <= limits.max_jerk_m_s3 * DT + 1e-9


@pytest.mark.parametrize("distance", [0.05, 0.3, 1.0, 4.0])
def test_trajectory_arrives_without_overshooting(distance: float) -> None:
    t = Trajectory(MotionConfig())
    goal = np.array([distance, 0.0, 0.0])
    most = 0.0
    for _ in range(600):
        t.advance(Aim(goal, 2.0, 0.5, 0.5), DT, None)
        most = max(most, float(t.position_m[0]))
    assert t.position_m == pytest.approx(goal, abs=0.005)
    assert most <= distance + 0.02
    assert t.yaw_rad == pytest.approx(2.0, abs=0.005)


def test_the_setpoint_waits_for_an_aircraft_that_cannot_follow() -> None:
    t = Trajectory(MotionConfig())
    for _ in range(400):
        t.advance(Aim(np.array([9.0, 0.0, 0.0]), 0.0, 0.5, 0.0), DT, np.zeros(3))
    assert t.position_m[0] <= MotionConfig().leash_m + 0.05


# -- track --------------------------------------------------------------------------------------------------------


def _pose(at_s: float, T: np.ndarray, counter: int = 0, map_id: str = "m") -> Pose:
    return Pose(
        stamp_ns=round(at_s * 1e9), seq=0, map_id=map_id, status="tracking", T_map_camera=to_transform(T),
        covariance=None, reset_counter=counter, graph_version=0, keyframe_id=None, T_keyframe_camera=None, inliers=0,
        up_sigma_rad=0.0, processing_ms=0.0,
    )  # fmt: skip


def _moving(track: PoseTrack, until_s: float, v: tuple[float, float, float], w: float) -> float:
    at = 1.0
    while at < until_s:
        T = level_camera(np.array(v) * at, w * at)
        track.add(_pose(at, T), 0)
        at += 1.0 / 15.0
    return at


def test_velocity_turn_and_prediction() -> None:
    track = PoseTrack()
    at = _moving(track, 3.0, (0.3, -0.2, 0.1), 0.4)
    assert track.velocity_m_s == pytest.approx((0.3, -0.2, 0.1), abs=1e-9)
    assert track.turn_rad_s == pytest.approx((0.0, 0.0, 0.4), abs=1e-6)
    T = track.predict(round((at + 0.2) * 1e9))
    assert T[:3, 3] == pytest.approx(np.array([0.3, -0.2, 0.1]) * (at + 0.2), abs=1e-6)
    assert camera_yaw(T) == pytest.approx(0.4 * (at + 0.2), abs=1e-6)


def test_a_told_correction_is_measured_and_the_velocity_turned() -> None:
    track = PoseTrack()
    at = _moving(track, 3.0, (0.3, 0.0, 0.0), 0.1)
    c = Correction(0.3, np.array([0.5, -0.2, 0.1]))
    T = level_camera(np.array([0.3 * at, 0.0, 0.0]), 0.1 * at)
    moved = T.copy()
    moved[:3, 3] = c.point(T[:3, 3])
    moved[:3, :3] = exp_rotation((0.0, 0.0, 0.3)) @ T[:3, :3]
    assert track.add(_pose(at, moved, 1), 0) is Step.CORRECTION
    assert track.correction is not None
    assert track.correction.yaw_rad == pytest.approx(0.3, abs=1e-6)
    assert track.correction.shift_m == pytest.approx(c.shift_m, abs=1e-5)
    assert track.velocity_m_s == pytest.approx(c.vector(np.array([0.3, 0.0, 0.0])), abs=1e-6)


def test_kinds_of_steps() -> None:
    track = PoseTrack()
    assert track.add(_pose(1.0, level_camera((0, 0, 0), 0.0)), 0) is Step.FIRST
    assert track.add(_pose(1.0, level_camera((0, 0, 0), 0.0)), 0) is Step.STALE
    assert track.add(_pose(1.1, level_camera((0.05, 0, 0), 0.0)), 0) is Step.SMOOTH
    assert track.add(_pose(1.2, level_camera((1.0, 0, 0), 0.0)), 0) is Step.JUMP
    assert track.add(_pose(1.3, level_camera((1.0, 0, 0), 0.5)), 0) is Step.JUMP
    lost = _pose(1.4, level_camera((1.0, 0, 0), 0.5)).model_copy(update={"T_map_camera": None, "status": "lost"})
    assert track.add(lost, 0) is Step.LOST
    assert track.lost
    assert track.add(_pose(3.5, level_camera((1.5, 0, 0), 0.5), 1), 0) is Step.RELOCATED
    assert track.add(_pose(3.6, level_camera((9.0, 0, 0), 0.5), 1, "n"), 0) is Step.CORRECTION
    assert not track.lost


@given(point, st.floats(-3.0, 3.0), point, st.floats(-3.0, 3.0), point)
def test_corrections_chain_and_go_back(
    a: tuple[float, float, float], yaw_a: float, b: tuple[float, float, float], yaw_b: float,
    p: tuple[float, float, float],
) -> None:  # fmt: skip
    first, second = Correction(yaw_a, np.array(a)), Correction(yaw_b, np.array(b))
    q = np.array(p)
    assert np.allclose(second.after(first).point(q), second.point(first.point(q)), atol=1e-9)
    assert np.allclose(first.back(first.point(q)), q, atol=1e-9)
    T = level_camera(q, 0.3)
    to = level_camera(first.point(q), 0.3 + yaw_a)
    again = correction_between(T, to)
    assert np.allclose(again.point(q), first.point(q), atol=1e-9)


# -- path ---------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_a_way_keeps_clear_of_all_trunks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    discs = [Disc(float(x), float(y), float(r)) for x, y, r in rng.uniform((-4.0, -4.0, 0.5), (4.0, 4.0, 0.95), (8, 3))]
    start, goal = rng.uniform(-5.0, 5.0, 2), rng.uniform(-5.0, 5.0, 2)
    if clearance_m(start, discs) < 0.1 or clearance_m(goal, discs) < 0.1:
        return
    way = plan(start, goal, discs)
    if way is None:
        return
    assert np.array_equal(way[-1], goal)
    here = start
    for corner in way:
        assert line_clearance_m(here, corner, discs) > -0.08, "half a cell at most"
        here = corner


def test_the_straight_line_is_taken_when_free_and_left_when_not() -> None:
    start, goal = np.array([0.0, 0.0]), np.array([4.0, 0.0])
    assert len(plan(start, goal, [Disc(2.0, 2.0, 0.9)]) or []) == 1
    around = plan(start, goal, [Disc(2.0, 0.1, 0.9)])
    assert around is not None
    assert len(around) > 1
    ring = [Disc(4.0 + 1.5 * np.cos(a), 1.5 * np.sin(a), 0.9) for a in np.linspace(0.0, 2 * np.pi, 9)]
    assert plan(start, goal, ring) is None


def test_the_way_around_a_long_wall_is_found_but_not_outside_the_fence() -> None:
    """A wall that reaches beyond the near grid: its end is 3.2 m to the side (bench missions, seed 2015)."""
    start, goal = np.array([0.0, 0.0]), np.array([0.0, 4.0])
    wall = [Disc(float(x), 2.0, 1.1) for x in np.arange(-8.0, 3.0, 1.0)]
    way = plan(start, goal, wall)
    assert way is not None
    assert max(float(corner[0]) for corner in way) > 3.0
    assert plan(start, goal, wall, Disc(0.0, 0.0, 5.0)) is not None
    assert plan(start, goal, wall, Disc(0.0, 0.0, 3.0)) is None


def test_the_place_to_dock_at_keeps_clear_of_the_neighbour() -> None:
    axis, here = np.array([3.0, 0.0]), np.array([0.0, 0.0])
    assert standoff(axis, here, 0.95, []) == pytest.approx((2.05, 0.0))
    neighbour = [Disc(2.2, 0.4, 0.9)]
    place = standoff(axis, here, 0.95, neighbour)
    assert clearance_m(place, neighbour) >= 0.0
    assert np.linalg.norm(place - axis) == pytest.approx(0.95)
    assert place[1] < 0.0


# -- docking ------------------------------------------------------------------------------------------------------


def _window(distance: float, bearing_deg: float, *, drift_m_s: float = 0.0, seconds: float = 3.2) -> DockMonitor:
    monitor = DockMonitor(DockConfig())
    for i in range(round(seconds * 15)):
        at = i / 15.0
        position = np.array([drift_m_s * at, 0.0, 1.4])
        monitor.add(DockSample(round(at * 1e9), distance, np.radians(bearing_deg), position))
    return monitor


@pytest.mark.parametrize(
    ("distance", "bearing_deg", "drift", "seconds", "docked"),
    [
        (0.95, 0.0, 0.0, 3.2, True),
        (0.86, 0.0, 0.0, 3.2, False),  # inside, but not by the margin
        (1.01, 0.0, 0.0, 3.2, False),
        (0.95, 3.5, 0.0, 3.2, False),
        (0.95, -2.0, 0.0, 3.2, True),
        (0.95, 0.0, 0.08, 3.2, False),
        (0.95, 0.0, 0.0, 2.5, False),
    ],
)
def test_docked_is_what_the_contract_says(
    distance: float, bearing_deg: float, drift: float, seconds: float, *, docked: bool
) -> None:
    verdict = _window(distance, bearing_deg, drift_m_s=drift, seconds=seconds).verdict()
    assert verdict.docked is docked, verdict.reason


def test_a_gap_begins_the_window_anew() -> None:
    monitor = _window(0.95, 0.0)
    monitor.add(DockSample(round(6.0 * 1e9), 0.95, 0.0, np.zeros(3)))
    assert not monitor.verdict().docked


# -- selection ----------------------------------------------------------------------------------------------------


def test_the_nearest_suitable_unvisited_tree() -> None:
    trees = [tree(1, 4.0, 0.0), tree(2, 2.0, 0.0, 0.3, suitable=False), tree(3, 3.0, 0.0), tree(4, 1.0, 0.0)]
    here = np.zeros(3)
    assert choose(trees, here, {4}, [], 0.3, None).tree is trees[2]
    assert choose(trees, here, {4}, [np.array([3.1, 0.1])], 0.3, None).tree is trees[0]
    assert choose(trees, here, set(), [], 0.3, 1).tree is trees[0]
    assert "not suitable" in choose(trees, here, set(), [], 0.3, 2).reason
    assert choose(trees, here, {1, 3, 4}, [], 0.3, None).tree is None


def test_a_leaning_axis_is_taken_at_the_cameras_height() -> None:
    lean = np.radians(15.0)
    leaning = tree(1, 2.0, 0.0).model_copy(update={"axis": (np.sin(lean), 0.0, np.cos(lean)), "z_m": 0.0})
    assert axis_at(leaning, 1.5) == pytest.approx((2.0 + 1.5 * np.tan(lean), 0.0))


def test_configuration_that_contradicts_itself_is_refused() -> None:
    with pytest.raises(ValueError, match="dock distances must rise"):
        DockConfig(aim_m=1.2)
    with pytest.raises(ValueError, match="Extra inputs"):
        NavigatorConfig(aim=1.0)  # type: ignore[call-arg]
