"""Smeared and noisy images are told from clear ones, and what follows from it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import inverse
from services.slam.config import SlamConfig
from services.slam.features import Extractor
from services.slam.keyframing import KeyframeRule
from services.slam.sharpness import Sharpness, sharpness
from services.slam.slam import Slam
from services.slam.tracking import Tracked
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot

U8 = NDArray[np.uint8]


def textured(seed: int = 0, shape: tuple[int, int] = (240, 320)) -> U8:
    """As fine as a lens draws, not finer."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, shape).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 1.2) + 8.0 * cv2.GaussianBlur(noise, (0, 0), 6.0)
    return np.clip(128.0 + 40.0 * soft / soft.std(), 0, 255).astype(np.uint8)


def finest(seed: int) -> U8:
    """As a renderer draws without a lens: half of the contrast changes from pixel to pixel."""
    grain = np.random.default_rng(900 + seed).normal(0.0, 10.0, (240, 320))
    return np.clip(textured(seed).astype(float) + grain, 0, 255).astype(np.uint8)


def smear(grey: U8, length: int, *, upright: bool = False) -> U8:
    kernel = np.full((length, 1) if upright else (1, length), 1.0 / length, np.float32)
    return np.asarray(cv2.filter2D(grey, -1, kernel), np.uint8)


def rained_on(grey: U8, share: float = 0.02) -> U8:
    rng = np.random.default_rng(5)
    out, bad = grey.copy(), rng.random(grey.shape) < share
    out[bad] = np.where(rng.random(int(bad.sum())) < 0.5, 0, 255)
    return out


def used_to_clear_images() -> Sharpness:
    judge = Sharpness()
    for seed in range(20):
        assert judge.judge(textured(seed))[0] is False
    return judge


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("length", [12, 30])
def test_a_smear_is_told_in_any_direction(length: int, upright: bool) -> None:
    assert used_to_clear_images().judge(smear(textured(50), length, upright=upright))[0] is True


def test_light_and_contrast_are_no_smear() -> None:
    judge = used_to_clear_images()
    for gain in (0.35, 2.0, 0.5):
        changed = np.clip(gain * textured(60).astype(np.float32), 0, 255).astype(np.uint8)
        assert judge.judge(changed)[0] is False


def test_the_first_images_are_never_smeared() -> None:
    judge = Sharpness()
    assert [judge.judge(smear(textured(seed), 20))[0] for seed in range(5)] == [False] * 5


def test_what_stays_soft_is_how_it_looks_here() -> None:
    judge = used_to_clear_images()
    told = [judge.judge(smear(textured(100 + k), 20))[0] for k in range(60)]
    assert told[:30] == [True] * 30
    assert not any(told[30:])


def test_single_wrong_pixels_are_taken_out_and_change_nothing_of_what_is_usual() -> None:
    judge = used_to_clear_images()
    clear = textured(70)
    for _ in range(60):
        smeared, mended = judge.judge(rained_on(clear))
        assert smeared is False
    off = np.abs(mended.astype(int) - clear.astype(int))
    assert off.max() < 60  # the wrong ones were 40 to 215 off
    assert np.median(off) <= 4
    assert judge.judge(clear)[0] is False
    assert judge.judge(smear(clear, 20))[0] is True


def test_where_all_is_drawn_pixel_by_pixel_nothing_is_noisy_but_what_is_noisier() -> None:
    judge = Sharpness()
    for seed in range(20):
        fine = finest(seed)
        assert sharpness(fine)[1] > 1.0
        smeared, same = judge.judge(fine)
        assert smeared is False
        assert same is fine
    rained = rained_on(finest(30), 0.05)
    assert judge.judge(rained)[1] is not rained
    assert judge.judge(smear(finest(40), 20))[0] is True


def test_a_blank_image_has_no_sharpness() -> None:
    assert sharpness(np.full((240, 320), 7, np.uint8)) == (0.0, 0.0)


def test_a_smeared_frame_makes_no_keyframe_however_little_of_the_map_it_sees() -> None:
    grey, depth_m = look(turn_on_the_spot(2, 1.0)[0])
    features = Extractor(INTRINSICS, SlamConfig(features=500)).extract(grey, depth_m)
    frame = Tracked(features, np.eye(3), np.zeros(3), np.full(len(features), -1, np.int32), inliers=30)
    rule = KeyframeRule(SlamConfig(features=500))
    assert rule.wants(0, frame, waiting=0)
    features.smeared = True
    assert not rule.wants(0, frame, waiting=0)


def test_after_a_jerk_the_camera_is_where_it_was_before_it() -> None:
    slam = Slam(INTRINSICS, SlamConfig(features=500))
    way = turn_on_the_spot(60, 60.0)
    rng = np.random.default_rng(2)
    for k, T_true in enumerate(way):
        grey, depth_m = look(T_true)
        if 30 <= k < 45:
            grey = smear(grey, int(rng.integers(10, 20)), upright=bool(rng.random() < 0.5))
        before = len(slam.atlas.slots)
        result = slam.track(round(k * 1e9 / 15.0), grey, depth_m)
        if 30 <= k < 45:
            assert len(slam.atlas.slots) <= before
        if k >= 45:
            assert result.T_map_camera is not None
            error = inverse(way[0]) @ T_true
            mine = inverse(slam.mapping.keyframe_pose(0)) @ result.T_map_camera
            assert (
                np.linalg.norm(mine[:3, 3] - error[:3, 3]) < 0.06
            )  # 0.10 with keyframes of smeared images; 0.035 without a jerk
