from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
import pytest

from services.camera.calibration.board import Board, Sighting, edge_width_px, find_board
from services.camera.calibration.coverage import Collector, Needs, tilts_rad
from services.camera.calibration.extrinsics import Mounting, board_in_body, mounting
from services.camera.calibration.judge import Limits, Picture, Result, calibrate, look
from services.camera.calibration.picture import residual_picture
from services.camera.calibration.report import camera_values, report_lines
from services.common.geometry import R_BODY_CAMERA, inverse, pose
from tests.board_views import DISTORTION, SIZE, Grey, K, board_at, good_poses, good_views, render

CHECKER, CHARUCO = Board(), Board(kind="charuco")
LIMITS = Limits()


@pytest.fixture(scope="module")
def views() -> dict[str, list[Grey]]:
    return {b.kind: list(good_views(b.kind)) for b in (CHECKER, CHARUCO)}


@pytest.fixture(scope="module")
def looked(views: dict[str, list[Grey]]) -> list[Picture]:
    return [look(str(k), image, CHECKER, LIMITS) for k, image in enumerate(views["checkerboard"])]


def judged(images: Sequence[Grey], board: Board = CHECKER) -> Result:
    return calibrate([look(str(k), image, board, LIMITS) for k, image in enumerate(images)], board, SIZE, LIMITS)


@pytest.mark.parametrize("board", [CHECKER, CHARUCO], ids=lambda b: b.kind)
def test_a_known_camera_is_found_again(views: dict[str, list[Grey]], board: Board) -> None:
    result = judged(views[board.kind], board)
    assert result.passed, result.faults
    s = result.solution
    assert s is not None
    assert s.rms_px < 0.15
    assert abs(s.K[0, 0] / K[0, 0] - 1.0) < 0.003
    assert abs(s.K[1, 1] / K[1, 1] - 1.0) < 0.003
    assert np.abs(s.K[:2, 2] - K[:2, 2]).max() < 1.0
    # the coefficients trade against each other: what they do to a pixel at the border is what counts
    ray = np.array([[0.5, 0.35, 1.0]])
    found, true = (
        cv2.projectPoints(ray, np.zeros(3), np.zeros(3), c, d)[0].ravel()
        for c, d in ((s.K, s.distortion), (K, DISTORTION))
    )
    assert np.abs(np.asarray(found) - np.asarray(true)).max() < 0.5
    told = abs(s.K[0, 0] - K[0, 0]) / s.sigma[0]
    assert told < 5.0, "the standard deviation must be of the error's size"


def test_corners_are_found_to_a_tenth_of_a_pixel(views: dict[str, list[Grey]]) -> None:
    for image, T in zip(views["checkerboard"][:4], good_poses(), strict=False):
        sighting = find_board(image, CHECKER)
        assert sighting is not None
        true, _ = cv2.projectPoints(CHECKER.points_m(), cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, DISTORTION)
        assert np.sqrt(np.mean(np.sum((sighting.points_px - np.asarray(true).reshape(-1, 2)) ** 2, axis=1))) < 0.1


def test_a_charuco_board_half_out_of_view_is_found(views: dict[str, list[Grey]]) -> None:
    image = render(CHARUCO, board_at(0.10, 0.0, 0.28), 1)
    sighting = find_board(image, CHARUCO)
    assert sighting is not None
    assert 16 <= len(sighting.ids) < 63
    assert find_board(render(CHECKER, board_at(0.10, 0.0, 0.28), 1), CHECKER) is None
    assert find_board(views["checkerboard"][0], CHARUCO) is None


def test_blur_and_shake_are_measured(views: dict[str, list[Grey]]) -> None:
    image = views["checkerboard"][2]
    sighting = find_board(image, CHECKER)
    assert sighting is not None
    sharp = edge_width_px(image, CHECKER, sighting)
    assert 1.0 < sharp < 2.5
    blurred = np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), dtype=np.uint8)
    assert edge_width_px(blurred, CHECKER, sighting) == pytest.approx(np.sqrt(2.0 * np.pi) * 2.0, rel=0.15)
    shaken = np.asarray(cv2.blur(image, (9, 1)), dtype=np.uint8)
    assert edge_width_px(shaken, CHECKER, sighting) > 2.5 * sharp


def test_a_blurred_set_is_a_clear_no() -> None:
    result = judged([render(CHECKER, T, k, blur_px=2.2) for k, T in enumerate(good_poses())])
    assert not result.passed
    assert "blurred" in result.faults[0]
    assert "hold the board still" in result.faults[0]


def test_too_few_pictures_are_a_clear_no(looked: list[Picture]) -> None:
    result = calibrate(looked[:5], CHECKER, SIZE, LIMITS)
    assert not result.passed
    assert result.faults[0] == "only 5 of 5 pictures can be used, 8 are needed: take more"
    assert not judged([]).passed


def test_frontal_pictures_are_a_clear_no() -> None:
    places = [(x, y, z) for z in (0.33, 0.4) for y in (-0.04, 0.0, 0.04) for x in (-0.06, 0.06)]
    result = judged([render(CHECKER, board_at(x, y, z, roll=0.02 * k), k) for k, (x, y, z) in enumerate(places)])
    assert not result.passed
    assert any("frontal pictures cannot tell focal length from distance" in fault for fault in result.faults)


def test_a_board_of_another_size_is_told(views: dict[str, list[Grey]]) -> None:
    result = judged(views["checkerboard"][:1], Board(8, 6))
    assert "8 x 6 inner corners, that is 9 x 7 squares" in result.faults[0]


def test_pictures_in_one_place_lack_coverage() -> None:
    poses = [board_at(0.0, 0.0, 0.75, 0.4 * np.cos(k), 0.4 * np.sin(k)) for k in range(10)]
    result = judged([render(CHECKER, T, k) for k, T in enumerate(poses)])
    assert any("of the picture" in fault and "hold the board at" in fault for fault in result.faults)


def test_a_picture_that_does_not_fit_is_left_out(looked: list[Picture]) -> None:
    pictures = list(looked)
    sighting = pictures[4].sighting
    assert sighting is not None
    bent = sighting.points_px.copy()
    bent[:, 0] += 3.0 * np.sin(bent[:, 1] / 20.0)
    pictures[4] = Picture("bent", "", dataclasses.replace(sighting, points_px=bent))
    result = calibrate(pictures, CHECKER, SIZE, LIMITS)
    assert result.solution is not None
    assert result.solution.left_out == (4,)
    assert result.passed
    assert "left out, they do not fit the others: bent" in report_lines(result, LIMITS)[1]


def test_random_corners_do_not_pass() -> None:
    rng = np.random.default_rng(0)
    pictures = [Picture(str(k), "", Sighting(np.arange(63), rng.uniform(0, 360, (63, 2)))) for k in range(12)]
    assert not calibrate(pictures, CHECKER, SIZE, LIMITS).passed


def test_hints_lead_to_a_set_that_passes(looked: list[Picture]) -> None:
    collector = Collector(CHECKER, SIZE, Needs(), most=30)
    assert "hold the board at" in collector.hints()[0]
    for picture in looked:
        sighting = picture.sighting
        assert sighting is not None
        taken = collector.offer(sighting)
        assert not collector.offer(sighting), "the same picture again adds nothing"
        assert taken
        if collector.done:
            break
    assert collector.hints() == []
    result = calibrate([Picture("", "", s) for s in collector.sightings], CHECKER, SIZE, LIMITS)
    assert result.coverage.covered >= 0.5


def test_tilts_are_told_apart() -> None:
    turn, tip = tilts_rad(board_at(0.0, 0.0, 1.0, turn=0.4))
    assert abs(turn) == pytest.approx(0.4)
    assert tip == pytest.approx(0.0, abs=1e-9)
    turn, tip = tilts_rad(board_at(0.0, 0.0, 1.0, tip=-0.3))
    assert turn == pytest.approx(0.0, abs=1e-9)
    assert abs(tip) == pytest.approx(0.3)


def test_the_mounting_is_found_from_one_picture() -> None:
    true = Mounting(
        pose(
            board_in_body((0, 0, 0), (0.02, 0.15, -0.1))[:3, :3] @ R_BODY_CAMERA.T @ R_BODY_CAMERA, (0.12, -0.03, 0.05)
        )
    )
    T_body_board = board_in_body((0.50, 0.0, 0.02), (0.0, 0.0, 0.1))
    image = render(CHECKER, inverse(true.T_body_camera) @ T_body_board, 3)
    sighting = find_board(image, CHECKER)
    assert sighting is not None
    found = mounting(sighting, CHECKER, K, DISTORTION, T_body_board)
    assert found is not None
    assert found.offset_m == pytest.approx((0.12, -0.03, 0.05), abs=0.002)
    assert found.angles_rad == pytest.approx((0.02, 0.15, -0.1), abs=0.005)


def test_a_camera_that_looks_down_by_the_bridges_convention() -> None:
    from services.common.mount import Mount

    mount = Mount.level((0.1, 0.0, -0.05), pitch_rad=0.2, yaw_rad=0.3)
    found = Mounting(mount.T_body_camera)
    assert found.angles_rad == pytest.approx((0.0, 0.2, 0.3), abs=1e-9)


def test_the_residual_picture_shows_something_and_the_camera_is_complete(looked: list[Picture]) -> None:
    result = calibrate(looked, CHECKER, SIZE, LIMITS)
    picture = residual_picture(result, LIMITS, "test")
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    assert 0.01 < np.mean(np.any(picture != 255, axis=2)) < 0.5
    assert result.solution is not None
    values = camera_values(result.solution, CHECKER, 1000.0)
    assert set(values) == {
        "width",
        "height",
        "fx",
        "fy",
        "cx",
        "cy",
        "k1",
        "k2",
        "p1",
        "p2",
        "k3",
        "depth_scale",
        "calibration",
    }
