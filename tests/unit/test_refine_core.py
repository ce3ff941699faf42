from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from services.common.geometry import R_BODY_CAMERA, exp_rotation, pose, rotation_z
from services.detector.refine.associate import Match, associate
from services.detector.refine.config import RefinerConfig
from services.detector.refine.model import Measurement
from services.detector.refine.refine import refine
from services.detector.refine.view import bearing_of_column, project, ray_table
from tests.unit.refine_scene import CAMERA, Cone, camera_at, render, sensed

CONFIG = RefinerConfig()
POSE_COVARIANCE = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.01]) ** 2


def _centre_error(measured: Measurement, cone: Cone, camera_z: float = 1.5) -> float:
    return float(np.hypot(*(np.array(measured.position_map_m) - cone.at(camera_z))))


@pytest.mark.parametrize("radius", [0.04, 0.08, 0.15, 0.2])
@pytest.mark.parametrize("distance", [1.0, 1.8, 3.0])
def test_one_trunk(radius: float, distance: float) -> None:
    cone = Cone(distance, 0.15, radius, lean=(0.03, -0.05))
    depth = sensed(render([cone], camera_at()), seed=round(1000 * (radius + distance)))
    expected = cone.expected(shift=(0.06, -0.05), radius_error=0.015)
    measured = refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02
    assert abs(measured.radius_m - radius) < 0.008
    assert measured.bearing_rad == pytest.approx(np.arctan2(cone.at(1.5)[1], cone.at(1.5)[0]), abs=0.005)
    assert measured.range_m == pytest.approx(np.hypot(*cone.at(1.5)), abs=0.02)
    assert measured.rms < 1.5


def test_tilted_camera() -> None:
    cone = Cone(2.0, -0.4, 0.1)
    R = rotation_z(-0.1) @ R_BODY_CAMERA @ exp_rotation([0.15, 0.0, 0.1])
    T = pose(R, [0.1, 0.2, 1.4])
    measured = refine(sensed(render([cone], T), 3), CAMERA, T, POSE_COVARIANCE, cone.expected(), [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone, 1.4) < 0.02
    offset = np.append(cone.at(1.4) - T[:2, 3], 0.0)
    assert measured.image_x_px == pytest.approx(project((offset @ T[:3, :3])[None], CAMERA)[0, 0], abs=2.0)
    assert bearing_of_column(measured.image_x_px, T, CAMERA)[0] == pytest.approx(measured.bearing_rad, abs=1e-6)


@pytest.mark.parametrize("gap", [0.15, 0.3])
def test_three_close_trunks_are_told_apart_under_a_common_shift(gap: float) -> None:
    step = gap + 0.2
    cones = [Cone(2.2, (k - 1) * step, 0.1) for k in range(3)]
    depth = sensed(render(cones, camera_at()), 11)
    for shift in ((0.0, 0.10), (0.05, -0.10)):
        expected = [cone.expected(k, shift=shift, sigma=0.05) for k, cone in enumerate(cones)]
        for k, cone in enumerate(cones):
            others = [tree for tree in expected if tree.id != k]
            measured = refine(depth, CAMERA, camera_at(), POSE_COVARIANCE * 16, expected[k], others, CONFIG)
            assert measured is not None
            assert _centre_error(measured, cone) < 0.02


@pytest.mark.parametrize("yaw", [0.0, 0.7, np.pi / 2, np.pi, -2.0])
def test_a_doubtful_heading_shifts_trees_sideways_wherever_the_camera_looks(
    yaw: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    stale = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.12]) ** 2
    T, turn = camera_at(yaw=yaw), rotation_z(yaw)[:2, :2]
    at, off = turn @ [3.0, 0.0], turn @ [0.0, -0.4]
    cone = Cone(float(at[0]), float(at[1]), 0.1)
    expected = cone.expected(shift=(float(off[0]), float(off[1])))
    matches = []

    def told(*given: Any) -> Match | None:
        matches.append(associate(*given))
        return matches[-1]

    monkeypatch.setattr("services.detector.refine.refine.associate", told)
    measured = refine(sensed(render([cone], T), 14), CAMERA, T, stale, expected, [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02
    assert matches[0] is not None
    assert matches[0].score == pytest.approx(6.24, abs=0.1)  # of a reward of 8, as far as 0.4 m in 0.36 m is doubtful


def test_the_biggest_object_is_not_the_target() -> None:
    thin, thick = Cone(2.5, 0.25, 0.05), Cone(1.9, -0.15, 0.2)
    depth = sensed(render([thin, thick], camera_at()), 5)
    measured = refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, thin.expected(), [thick.expected(1)], CONFIG)
    assert measured is not None
    assert _centre_error(measured, thin) < 0.02


def test_a_hidden_tree_is_not_replaced_by_the_one_before_it() -> None:
    front, hidden = Cone(1.5, 0.0, 0.15), Cone(2.0, 0.0, 0.1)
    depth = sensed(render([front, hidden], camera_at()), 6)
    assert refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, hidden.expected(), [front.expected(1)], CONFIG) is None
    assert refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, hidden.expected(), [], CONFIG) is None


def test_half_hidden_tree() -> None:
    front, back = Cone(1.4, 0.10, 0.1), Cone(2.2, 0.0, 0.12)
    depth = sensed(render([front, back], camera_at()), 8)
    measured = refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, back.expected(), [front.expected(1)], CONFIG)
    assert measured is not None
    assert _centre_error(measured, back) < 0.03
    assert abs(measured.radius_m - back.radius) < 0.02


@pytest.mark.parametrize("y", [0.62, 0.70, -0.66])
def test_half_out_of_view(y: float) -> None:
    cone = Cone(1.1, y, 0.15)
    measured = refine(
        sensed(render([cone], camera_at()), 9), CAMERA, camera_at(), POSE_COVARIANCE, cone.expected(), [], CONFIG
    )
    assert measured is not None
    assert _centre_error(measured, cone) < 0.03


def test_trunk_fills_the_image() -> None:
    cone = Cone(0.62, 0.0, 0.2, taper=0.0)
    intrinsics = CAMERA.model_copy(update={"fx": 1100.0, "fy": 1100.0})
    depth = sensed(render([cone], camera_at(), intrinsics), 10)
    depth[depth == 0] = 0.0
    measured = refine(depth, intrinsics, camera_at(), POSE_COVARIANCE, cone.expected(), [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02


def test_ground_slope_and_wrong_ground_height() -> None:
    cone = Cone(2.0, 0.2, 0.1, bottom=-2.0)
    depth = sensed(render([cone], camera_at(), slope=(0.15, 0.1)), 12)
    expected = cone.expected()
    measured = refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02


def test_distorted_camera() -> None:
    intrinsics = CAMERA.model_copy(update={"k1": 0.26, "k2": -0.95, "p1": -0.005, "p2": 0.0026, "k3": 1.16})
    cone = Cone(1.8, 0.5, 0.1)
    depth = sensed(render([cone], camera_at(), intrinsics), 13)
    measured = refine(depth, intrinsics, camera_at(), POSE_COVARIANCE, cone.expected(), [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02
    x, y = ray_table(intrinsics)
    pixels = project(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1).astype(float), intrinsics)
    assert np.max(np.abs(pixels[:, 0].reshape(480, 640) - np.arange(640))) < 0.05


def test_nothing_there() -> None:
    expected = Cone(2.0, 0.0, 0.1).expected()
    empty = sensed(render([], camera_at()), 1)
    assert refine(empty, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG) is None
    wall = np.full((480, 640), 2.0, np.float32)
    assert refine(wall, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG) is None


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, 65.535, -1.0])
def test_depth_without_sense(value: float) -> None:
    depth = np.full((480, 640), value, np.float32)
    expected = Cone(2.0, 0.0, 0.1).expected()
    assert refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG) is None


def test_a_tree_behind_the_camera_and_a_camera_that_looks_down() -> None:
    expected = Cone(-2.0, 0.0, 0.1).expected()
    depth = np.full((480, 640), 2.0, np.float32)
    assert refine(depth, CAMERA, camera_at(), None, expected, [], CONFIG) is None
    down = pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 1.5])
    assert refine(depth, CAMERA, down, None, expected, [], CONFIG) is None


def test_same_input_same_answer() -> None:
    cone = Cone(2.0, 0.1, 0.1)
    depth = sensed(render([cone], camera_at()), 4)
    first, second = (refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, cone.expected(), [], CONFIG) for _ in range(2))
    assert first is not None
    assert second is not None
    assert first.position_map_m == second.position_map_m
    assert np.array_equal(first.covariance, second.covariance)


@pytest.mark.parametrize("slope", [(0.36, 0.0), (-0.36, 0.1), (0.1, -0.4)])
def test_steep_ground(slope: tuple[float, float]) -> None:
    cone = Cone(2.2, -0.2, 0.1, bottom=-3.0)
    z = slope[0] * cone.x + slope[1] * cone.y
    depth = sensed(render([cone], camera_at(), slope=slope), 14)
    expected = replace(cone.expected(shift=(0.04, 0.04)), z_m=z)
    measured = refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02


@pytest.mark.parametrize("seed", range(4))
def test_undergrowth_before_the_trunk(seed: int) -> None:
    """Leaves at any depth up to a metre high, before and behind, hide four fifths of the lower half."""
    cone = Cone(2.2, 0.1, 0.1)
    rng = np.random.default_rng(seed)
    depth = render([cone], camera_at())
    for _ in range(260):
        u, v, size = int(rng.integers(0, 620)), int(rng.integers(300, 470)), int(rng.integers(4, 22))
        near = rng.uniform(1.2, 3.5)
        patch = depth[v : v + size, u : u + size]
        np.minimum(patch, near, out=patch)
    measured = refine(sensed(depth, seed), CAMERA, camera_at(), POSE_COVARIANCE, cone.expected(), [], CONFIG)
    assert measured is not None
    assert _centre_error(measured, cone) < 0.02
    assert abs(measured.radius_m - cone.radius) < 0.01


def test_depth_told_in_the_wrong_unit_is_not_measured() -> None:
    cone = Cone(2.0, 0.1, 0.1)
    for factor in (0.2, 0.5, 2.0, 5.0):
        depth = sensed(render([cone], camera_at()), 15) * np.float32(factor)
        assert refine(depth, CAMERA, camera_at(), POSE_COVARIANCE, cone.expected(), [], CONFIG) is None


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_no_tree(seed: int) -> None:
    rng = np.random.default_rng(seed)
    expected = Cone(2.0, 0.0, 0.1).expected()
    speckle = rng.uniform(0.5, 6.0, (480, 640)).astype(np.float32)
    assert refine(speckle, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG) is None
    wall = (2.0 + 0.02 * rng.normal(size=(480, 640))).astype(np.float32)
    assert refine(wall, CAMERA, camera_at(), POSE_COVARIANCE, expected, [], CONFIG) is None
