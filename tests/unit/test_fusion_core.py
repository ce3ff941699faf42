"""The fusion's core: preintegration, poses without the first camera, jumps, gaps, and the same again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from services.common.geometry import Matrix, inverse, log_rotation, pose
from services.common.mount import Mount
from services.fusion.config import FusionConfig, SecondCameraConfig
from services.fusion.fuser import Fuser
from services.fusion.inertial import Inertial
from services.fusion.values import Fused, Located, adjoint, carried, relative
from tests.unit.fusion_motion import FRAME_S, T_BODY_CAMERA, located, reading, stamp_ns, true_body

PERIOD_S = 0.008
DOWN: Matrix = Mount.level((0.0, 0.0, -0.05), np.pi / 2).T_body_camera
Sees = Callable[[float, np.random.Generator], Located | None]


def fly(
    seconds: float, sees: Sees, config: FusionConfig | None = None, *, imu: Callable[[float], bool] = lambda _: True,
    second: Sees | None = None, late_s: float = 0.0, wild: float = 1.0,
) -> tuple[list[tuple[float, Fused | None]], Fuser]:  # fmt: skip
    """Run a flight: readings, frames of the first and of the second camera in order; returns what was told when."""
    config = config or FusionConfig()
    fuser = Fuser(config, T_BODY_CAMERA, DOWN if second else None)
    rng, frames, told = np.random.default_rng(7), 0, []
    for k in range(-25, round(seconds / PERIOD_S)):
        t_s = k * PERIOD_S
        if imu(t_s - late_s):
            fuser.imu(reading(t_s - late_s, PERIOD_S, rng, bias=0.06, wild=wild))
        if t_s < frames * FRAME_S:
            continue
        at_s = frames * FRAME_S
        frames += 1
        fused = fuser.camera(stamp_ns(at_s), sees(at_s, rng))
        if second is not None:
            fused = fuser.second(stamp_ns(at_s), second(at_s, rng)) or fused
        told.append((at_s, fused))
    return told, fuser


def sees_all(t_s: float, rng: np.random.Generator) -> Located | None:
    return located(t_s, rng)


def dark(begin_s: float, end_s: float) -> Sees:
    """Return a camera that sees nothing for a while and finds its place again with a new reset counter."""

    def sees(t_s: float, rng: np.random.Generator) -> Located | None:
        place = located(t_s, rng, reset=int(t_s >= end_s))
        return None if begin_s <= t_s < end_s else place

    return sees


def error_m(t_s: float, fused: Fused) -> float:
    return float(np.linalg.norm(fused.T_map_camera[:3, 3] - (true_body(t_s) @ T_BODY_CAMERA)[:3, 3]))


# -- preintegration ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("from_s", "to_s"), [(0.5, 1.5), (1.003, 1.997), (2.0, 2.05)])
def test_preintegration_is_the_integral_of_a_known_motion(from_s: float, to_s: float) -> None:
    import gtsam

    inertial = Inertial(FusionConfig().imu_noise)
    for k in range(1, 1050):
        inertial.add(reading(k * 0.0025, 0.0025))
    before, after = true_body(from_s), true_body(to_s)
    velocity = (true_body(from_s + 1e-4)[:3, 3] - true_body(from_s - 1e-4)[:3, 3]) / 2e-4
    bias = gtsam.imuBias.ConstantBias()
    nav = inertial.between(stamp_ns(from_s), stamp_ns(to_s), bias).predict(
        gtsam.NavState(gtsam.Pose3(before), velocity), bias
    )
    found = nav.pose().matrix()
    assert np.linalg.norm(found[:3, 3] - after[:3, 3]) < 1e-3
    assert np.linalg.norm(log_rotation(found[:3, :3].T @ after[:3, :3])) < 3e-4


def test_a_gap_of_the_readings_is_told() -> None:
    inertial = Inertial(FusionConfig().imu_noise)
    for k in (*range(1, 60), *range(75, 130)):
        inertial.add(reading(k * PERIOD_S, PERIOD_S))
    assert inertial.covers(stamp_ns(0.1), stamp_ns(0.4))
    assert not inertial.covers(stamp_ns(0.4), stamp_ns(0.7))
    assert not inertial.covers(stamp_ns(0.9), stamp_ns(1.2)), "nothing is known so far ahead of the last reading"
    assert not inertial.add(reading(0.5, PERIOD_S)), "older than the last"


# -- values -----------------------------------------------------------------------------------------------------------
def test_covariances_are_those_of_the_perturbations() -> None:
    rng = np.random.default_rng(3)
    T = true_body(1.3) @ T_BODY_CAMERA
    xi = 1e-6 * rng.standard_normal(6)
    small = pose(np.eye(3) + 1e-9 * np.zeros((3, 3)), xi[3:])
    small[:3, :3] = np.eye(3) + np.array([[0.0, -xi[2], xi[1]], [xi[2], 0.0, -xi[0]], [-xi[1], xi[0], 0.0]])
    through = T @ small @ inverse(T)
    moved = adjoint(T) @ xi
    assert np.allclose(through[:3, 3], moved[3:], atol=1e-10)
    anchor, motion = located(1.0), inverse(located(1.0).T_map_camera) @ located(1.5).T_map_camera
    P = np.diag(rng.uniform(0.01, 0.02, 6) ** 2)
    here, covariance = carried(anchor, motion, P)
    draws = []
    for _ in range(4000):
        e = np.sqrt(anchor.covariance.diagonal()) * rng.standard_normal(6)
        d = np.sqrt(P.diagonal()) * rng.standard_normal(6)
        turn, step = Mount.level((0.0, 0.0, 0.0)), e  # the anchor errs in map, the motion at its own end
        del turn
        T_anchor = pose(rotation(step[3:]) @ anchor.T_map_camera[:3, :3], anchor.T_map_camera[:3, 3] + step[:3])
        end = T_anchor @ motion @ pose(rotation(d[:3]), d[3:])
        draws.append(end[:3, 3] - here[:3, 3])
    assert np.allclose(np.cov(np.array(draws).T), covariance[:3, :3], rtol=0.15, atol=1e-5)


def rotation(r: Matrix) -> Matrix:
    from services.common.geometry import exp_rotation

    return exp_rotation(r)


def test_the_body_moves_as_the_camera_on_it() -> None:
    moved = relative(located(1.0), located(2.0), T_BODY_CAMERA)
    assert np.allclose(moved.T, inverse(true_body(1.0)) @ true_body(2.0), atol=1e-9)


# -- without the first camera -----------------------------------------------------------------------------------------
def test_a_located_pose_is_slams_own() -> None:
    told, fuser = fly(4.0, sees_all)
    rng = np.random.default_rng(7)
    assert all(f is not None and f.carrier == "camera" for _, f in told)
    assert fuser.restarts == fuser.guard.contradicted == 0
    del rng
    fused = told[-1][1]
    assert fused is not None
    assert np.array_equal(fused.covariance, np.diag(np.repeat([0.006**2, 0.002**2], 3)))


def test_the_imu_carries_the_pose_for_a_second_and_says_how_well() -> None:
    told, fuser = fly(9.0, dark(5.0, 7.0))
    carried_poses = [(t, f) for t, f in told if f is not None and f.carrier == "imu"]
    assert 0.8 < carried_poses[-1][0] - carried_poses[0][0] <= 1.0
    assert all(f is None for t, f in told if 6.1 < t < 7.0)
    errors = [error_m(t, f) for t, f in carried_poses]
    assert max(errors) < 0.12
    ratios = [error_m(t, f) ** 2 / np.trace(f.covariance[:3, :3]) for t, f in carried_poses]
    assert 0.02 < float(np.mean(ratios)) < 4.0
    sigmas = [float(np.trace(f.covariance[:3, :3])) for _, f in carried_poses]
    assert sigmas == sorted(sigmas), "the doubt only grows"
    assert [f.carrier for t, f in told if f is not None and t >= 7.0] == ["camera"] * sum(t >= 7.0 for t, _ in told)
    assert fuser.restarts == 0
    assert np.allclose(fuser.bias[0], 0.06, atol=0.05)


def test_without_imu_there_is_no_pose_in_the_dark() -> None:
    told, _ = fly(6.0, dark(4.0, 5.0), FusionConfig(imu=False))
    assert all((f is None) == (4.0 <= t < 5.0) for t, f in told)


def test_a_silent_slam_is_carried_on_too() -> None:
    told, fuser = fly(4.0, sees_all)
    last_s = told[-1][0]
    for k in range(round(last_s / PERIOD_S) + 1, round((last_s + 0.4) / PERIOD_S)):
        fuser.imu(reading(k * PERIOD_S, PERIOD_S, bias=0.06))
    fused = fuser.silence(fuser.inertial.newest_ns)
    assert fused is not None
    assert fused.carrier == "imu"
    assert error_m((fused.stamp_ns - stamp_ns(0.0)) * 1e-9, fused) < 0.05


@pytest.mark.parametrize("late_s", [0.0, 0.09])
def test_a_short_jump_of_slam_is_not_told(late_s: float) -> None:
    def sees(t_s: float, rng: np.random.Generator) -> Located | None:
        return located(t_s, rng, shift_m=0.4 if 4.0 <= t_s < 4.4 else 0.0)

    told, fuser = fly(6.0, sees, late_s=late_s)
    assert fuser.guard.contradicted > 0
    assert fuser.jumps_announced == 0
    poses = [((f.stamp_ns - stamp_ns(0.0)) * 1e-9, f) for _, f in told if f is not None]
    assert max(error_m(t, f) for t, f in poses) < 0.1
    assert len(told) - len(poses) <= (2 if late_s else 0), "till samples of a later moment are there"


@pytest.mark.parametrize("late_s", [0.0, 0.09])
def test_a_jump_that_stays_is_announced(late_s: float) -> None:
    def sees(t_s: float, rng: np.random.Generator) -> Located | None:
        return located(t_s, rng, shift_m=0.4 if t_s >= 4.0 else 0.0)

    told, fuser = fly(6.5, sees, late_s=late_s)
    assert fuser.resets == fuser.jumps_announced == 1
    steps = [(t, f) for t, f in told if f is not None]
    assert error_m(*steps[-1]) == pytest.approx(0.4, abs=0.03)
    first = next(t for t, f in steps if error_m(t, f) > 0.3)
    assert 4.6 <= first <= 5.0


def test_a_correction_that_slam_told_passes_at_once() -> None:
    def sees(t_s: float, rng: np.random.Generator) -> Located | None:
        return located(t_s, rng, reset=int(t_s >= 4.0), shift_m=0.4 if t_s >= 4.0 else 0.0)

    told, fuser = fly(5.0, sees)
    assert all(f is not None and f.carrier == "camera" for _, f in told)
    assert fuser.resets == 0


def test_a_gap_of_the_imu_begins_a_new_window_and_poses_go_on() -> None:
    told, fuser = fly(9.0, dark(7.5, 8.0), imu=lambda t: not 3.0 < t < 4.0)
    assert fuser.restarts >= 1
    assert all(f is not None for _, f in told)
    assert {f.carrier for t, f in told if f is not None and 7.5 <= t < 8.0} == {"imu"}


def test_samples_that_come_late_serve_all_the_same() -> None:
    """The IMU's samples arrive 90 ms after slam's poses of the same moment."""
    told, fuser = fly(6.0, dark(5.0, 6.0), late_s=0.09)
    carried_poses = [(t, f) for t, f in told if f is not None and f.carrier == "imu"]
    assert len(carried_poses) >= 10
    assert max(error_m((f.stamp_ns - stamp_ns(0.0)) * 1e-9, f) for _, f in carried_poses) < 0.12
    assert fuser.restarts == 0


def test_an_imu_that_lies_is_left_out_in_the_end() -> None:
    told, fuser = fly(9.0, sees_all, wild=300.0)
    assert fuser.guard.banned_until_ns > 0
    assert all(f is not None and f.carrier == "camera" for t, f in told if t > 7.0)
    assert max(error_m(t, f) for t, f in told if f is not None) < 1.1


def test_the_second_camera_carries_the_pose_through_a_long_blackout() -> None:
    config = FusionConfig(second=SecondCameraConfig(enabled=True))

    def below(t_s: float, rng: np.random.Generator) -> Located | None:
        first = located(t_s, rng)
        T = first.T_map_camera @ inverse(T_BODY_CAMERA) @ DOWN
        return Located(first.stamp_ns, T, first.covariance, ("below", 0))

    for imu in (True, False):
        told, fuser = fly(9.0, dark(4.0, 8.0), config.model_copy(update={"imu": imu}), second=below)
        carried_poses = [(t, f) for t, f in told if f is not None and f.carrier == "second"]
        assert len(carried_poses) >= 55
        assert max(error_m(t, f) for t, f in carried_poses) < 0.08
        assert fuser.restarts == 0


def test_the_same_flight_gives_the_same_poses() -> None:
    first, second = (fly(6.0, dark(4.0, 5.0))[0] for _ in range(2))
    for (_, a), (_, b) in zip(first, second, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            assert np.array_equal(a.T_map_camera, b.T_map_camera)
            assert np.array_equal(a.covariance, b.covariance)


@pytest.mark.parametrize("gps", [False, True])
def test_without_imu_a_place_found_again_is_a_step_over_the_gap(gps: bool) -> None:
    """It was taken for one frame's step: after two dark seconds in a turn the world was 10 degrees off, and an honest GPS distrusted."""
    fuser, rng = Fuser(FusionConfig(imu=False, gps=gps), T_BODY_CAMERA), np.random.default_rng(3)
    for k in range(150):
        t_s = k * FRAME_S
        dark = 3.0 < t_s < 5.0
        fuser.camera(stamp_ns(t_s), None if dark else located(t_s, rng, reset=int(t_s >= 5.0)))
    assert fuser.smoother is not None
    t_s = (fuser.smoother.last.stamp_ns - stamp_ns(0.0)) * 1e-9
    off = inverse(true_body(t_s)) @ fuser.smoother.last.T_W_body
    assert np.linalg.norm(off[:3, 3]) < 0.1
    assert np.linalg.norm(log_rotation(off[:3, :3])) < np.radians(2.0)
