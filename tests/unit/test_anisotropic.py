"""A camera whose image is squeezed and whose depth leaves margins at the sides (the R200): every projection takes fx and fy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from schemas.camera import Intrinsics
from schemas.trees import Tree
from services.camera.depth.geometry import register
from services.common.geometry import R_BODY_CAMERA, exp_rotation, inverse, level_camera, pose, rotation_z
from services.detector.refine.config import RefinerConfig
from services.detector.refine.refine import refine
from services.detector.refine.view import project
from services.navigator.guard import look
from services.preview.overlay import trunk_outline
from services.slam.camera import camera_model
from services.slam.config import SlamConfig
from tests.unit.refine_scene import Cone, camera_at, render, sensed

R200 = Intrinsics(width=640, height=480, fx=457.0, fy=609.0, cx=319.5, cy=239.5)
MARGIN_PX = 61
POSE_COVARIANCE = np.diag([0.02, 0.02, 0.02, 0.005, 0.005, 0.01]) ** 2


@pytest.mark.parametrize("yaw", [0.0, 0.3, -0.3])
def test_the_refiner_measures_the_trunk(yaw: float) -> None:
    cone = Cone(2.0, 0.1, 0.12, lean=(0.03, -0.05))
    R = rotation_z(yaw) @ R_BODY_CAMERA @ exp_rotation([0.1, 0.0, 0.08])
    T = pose(R, [0.0, 0.0, 1.5])
    depth = sensed(render([cone], T, R200), 3)
    measured = refine(depth, R200, T, POSE_COVARIANCE, cone.expected(shift=(0.04, 0.03)), [], RefinerConfig())
    assert measured is not None
    assert np.hypot(*(np.array(measured.position_map_m) - cone.at(1.5))) < 0.02
    assert abs(measured.radius_m - 0.12) < 0.008


@pytest.mark.parametrize("shown_px", [12, 25, 40])
def test_a_trunk_that_the_margin_cuts_is_not_taken_for_a_thin_one(shown_px: int) -> None:
    """The depth image ends within the trunk: what is missing lies in the margin, not beside the trunk."""
    cone = Cone(2.0, 0.0, 0.15, taper=0.0)
    right_edge = math.asin(0.15 / 2.0)
    first_shown = math.atan((MARGIN_PX - R200.cx) / R200.fx)  # negative: left of the middle
    yaw = first_shown + math.atan(shown_px / R200.fx) - right_edge
    T = camera_at(yaw=yaw)
    depth = sensed(render([cone], T, R200), 4)
    depth[:, :MARGIN_PX] = depth[:, -MARGIN_PX:] = 0.0
    measured = refine(depth, R200, T, POSE_COVARIANCE, cone.expected(shift=(0.02, 0.02)), [], RefinerConfig())
    if measured is not None:
        assert abs(measured.radius_m - 0.15) < 0.02
        assert np.hypot(*(np.array(measured.position_map_m) - cone.at(1.5))) < 0.04


def test_registration_from_a_squeezed_camera_leaves_no_gaps() -> None:
    squeezed = Intrinsics(width=160, height=120, fx=152.0, fy=114.0, cx=79.5, cy=59.5)
    square = squeezed.model_copy(update={"fx": 150.0, "fy": 150.0, "height": 157, "cy": 78.1})
    wall = np.full((120, 160), 2.0, np.float32)
    assert (register(wall, squeezed, square, np.eye(4))[2:-2, 2:-2] == 2.0).all()


def test_the_guard_puts_obstacles_where_they_are() -> None:
    cone = Cone(2.0, 0.5, 0.1, taper=0.0)
    T = camera_at()
    depth = (np.nan_to_num(render([cone], T, R200), posinf=0.0) * 1000.0).astype(np.uint16)
    points = look(depth, R200, T, 0).points_m
    near = points[np.hypot(points[:, 0], points[:, 1]) < 2.3]
    near = near[np.abs(near[:, 2]) < 0.5]
    assert len(near) > 20
    assert np.abs(np.hypot(near[:, 0] - 2.0, near[:, 1] - 0.5) - 0.1).max() < 0.01


def test_the_overlay_outlines_what_the_camera_sees() -> None:
    tree = Tree(
        id=1, x_m=2.0, y_m=0.3, z_m=-1.5, axis=(0.0, 0.0, 1.0), radius_m=0.1, radius_height_m=1.3, height_seen_m=3.0,
        sigma_xy_m=0.01, sigma_radius_m=0.01, arc_rad=1.5, confidence=0.9, observations=5, suitable=True,
    )  # fmt: skip
    T = level_camera([0.0, 0.0, 0.0], 0.0)
    outline = trunk_outline(tree, inverse(T), R200)
    assert outline is not None
    columns = np.flatnonzero((render([Cone(2.0, 0.3, 0.1, taper=0.0, bottom=-9.0)], T, R200) < 2.2)[240])
    assert outline.corners[0][0] == pytest.approx(columns[0], abs=3.0)
    assert outline.corners[1][0] == pytest.approx(columns[-1], abs=3.0)
    low = project(np.array([[-0.3, 1.3, 2.0]]), R200)[0, 1]
    assert outline.corners[0][1] == pytest.approx(low, abs=0.25 * R200.fy)


def test_slams_doubt_of_far_points_is_between_both_focal_lengths() -> None:
    model = camera_model(R200, SlamConfig())
    assert R200.fx < model.focal < R200.fy
    square = R200.model_copy(update={"fy": R200.fx})
    assert camera_model(square, SlamConfig()).focal == pytest.approx(R200.fx)
