"""Fog, dusk, a bare wall: flat images are searched with their contrast stretched, others are left as they are."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.slam.binary import match_all
from services.slam.config import SlamConfig
from services.slam.detect import Detector, stretch
from services.slam.features import Extractor, Features

CAMERA = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
DEPTH_M = np.full((480, 640), 2.0, np.float32)


def clear() -> NDArray[np.uint8]:
    """Blobs of many sizes."""
    rng = np.random.default_rng(3)
    picture = np.zeros((480, 640))
    for size in (8, 16, 32):
        picture += np.kron(rng.normal(0.0, 30.0, (480 // size, 640 // size)), np.ones((size, size)))
    return np.clip(128.0 + picture, 0, 255).astype(np.uint8)


def foggy(seed: int) -> NDArray[np.uint8]:
    """Blurred, a tenth of the contrast, a sensor's noise."""
    soft = cv2.GaussianBlur(clear().astype(np.float32), (0, 0), 2.5)
    return np.clip(128.0 + 0.1 * (soft - 128.0) + np.random.default_rng(seed).normal(0.0, 1.5, soft.shape), 0, 255).astype(
        np.uint8
    )  # fmt: skip


def agreeing(a: Features, b: Features) -> int:
    """Matches by descriptor that lie in one place."""
    match = match_all(a.desc, b.desc, 60, 0.85)
    found = np.flatnonzero(match >= 0)
    apart = np.linalg.norm(a.uv[found] - b.uv[match[found]], axis=1)
    return int(np.count_nonzero(apart < 3.0 * 1.2 ** a.octave[found]))


def test_a_foggy_image_still_has_features_that_are_found_again_and_in_the_clear() -> None:
    thick, again, sharp = (Extractor(CAMERA, SlamConfig()).extract(g, DEPTH_M) for g in (foggy(1), foggy(2), clear()))
    assert len(thick) > 600
    assert thick.octave.min() >= 3  # what is finer is noise
    assert agreeing(thick, again) > 200
    assert agreeing(thick, sharp) > 60


def test_a_clear_image_is_searched_as_it_is() -> None:
    image = clear()
    searched, corners = Detector(992, 8, 1.2, 19, 7).detect(image, DEPTH_M)
    assert searched is image
    assert len(corners[0]) > 600


def test_an_empty_image_is_not_stretched_without_bounds() -> None:
    noise = stretch(np.random.default_rng(1).integers(126, 130, (480, 640), dtype=np.uint8))
    assert noise is not None
    assert noise.std() < 8.0
    even = stretch(np.full((480, 640), 7, np.uint8))
    assert even is not None
    assert np.ptp(even) == 0


def test_an_image_smeared_by_motion_is_not_stretched() -> None:
    smeared = cv2.blur(clear(), (31, 1)).astype(np.uint8)
    assert stretch(smeared) is None
    searched, _ = Detector(992, 8, 1.2, 19, 7).detect(smeared, DEPTH_M)
    assert searched is smeared


@pytest.mark.parametrize("wanted", [500, 700])
def test_corners_carried_out_of_the_fog_leave_no_more_than_a_keyframe_holds(wanted: int) -> None:
    """In the fog all corners are coarse: carried into a clear image they were more than its coarse levels have room for."""
    extractor = Extractor(CAMERA, SlamConfig(features=wanted))
    for image in (foggy(1), foggy(2), clear()):
        features = extractor.extract(image, DEPTH_M)
        assert 0.4 * wanted < len(features) <= wanted
