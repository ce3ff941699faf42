"""In fog corners are carried on by their patches: they stay in their place to a fraction of what finding them anew costs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.slam.binary import match_all
from services.slam.carry import _AFTER, apart, carried
from services.slam.config import SlamConfig
from services.slam.detect import stretch
from services.slam.features import Extractor, Features

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

WIDTH, HEIGHT = 640, 480
CAMERA = Intrinsics(width=WIDTH, height=HEIGHT, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
DEPTH_M = np.full((HEIGHT, WIDTH), 2.0, np.float32)
STEP_PX = np.array([6.3, -2.6])
"""The scene moves by so much in the image from frame to frame."""


def scene() -> NDArray[np.float32]:
    rng = np.random.default_rng(3)
    picture = np.zeros((HEIGHT, 2 * WIDTH))
    for size in (8, 16, 32):
        picture += np.kron(rng.normal(0.0, 30.0, (HEIGHT // size, 2 * WIDTH // size)), np.ones((size, size)))
    return np.clip(128.0 + picture, 0, 255).astype(np.float32)


def view(number: int, *, fog: bool) -> U8:
    """The scene after so many steps, in fog with a noise of its own."""
    shift = np.array([[1.0, 0.0, -100.0 + number * STEP_PX[0]], [0.0, 1.0, number * STEP_PX[1]]])
    picture = cv2.warpAffine(scene(), shift, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    if fog:
        soft = cv2.GaussianBlur(picture, (0, 0), 2.5)
        picture = 128.0 + 0.15 * (soft - 128.0) + np.random.default_rng(number).normal(0.0, 1.5, soft.shape)
    return np.clip(picture, 0, 255).astype(np.uint8)


def off_px(before: Features, now: Features) -> F64:
    """How far matched corners are from where the step took them, (N, 2); wrong matches are left out."""
    match = match_all(before.desc, now.desc, 60, 0.9)
    found = np.flatnonzero(match >= 0)
    off = now.uv[match[found]] - before.uv[found] - STEP_PX
    return off[np.linalg.norm(off, axis=1) < 10.0]


def spread_px(off: F64) -> float:
    """Standard deviation per axis, by the median."""
    return float(1.48 * np.median(np.abs(off - np.median(off, axis=0))))


def test_corners_of_a_flat_image_stay_in_their_place() -> None:
    one = Extractor(CAMERA, SlamConfig())
    frames = [one.extract(view(number, fog=True), DEPTH_M) for number in range(5)]
    anew = [Extractor(CAMERA, SlamConfig()).extract(view(number, fog=True), DEPTH_M) for number in (3, 4)]
    assert all(len(frame) > 500 for frame in frames)
    off = off_px(frames[3], frames[4])
    assert len(off) > 200
    assert spread_px(off) < 0.3 * spread_px(off_px(*anew))
    assert np.abs(np.median(off, axis=0)).max() < 0.1


def test_where_fog_begins_the_clear_images_corners_are_carried_into_it() -> None:
    one = Extractor(CAMERA, SlamConfig())
    clear, foggy = one.extract(view(0, fog=False), DEPTH_M), one.extract(view(1, fog=True), DEPTH_M)
    off = off_px(clear, foggy)
    anew = off_px(clear, Extractor(CAMERA, SlamConfig()).extract(view(1, fog=True), DEPTH_M))
    assert len(off) > len(anew)
    assert spread_px(off) < 0.5 * spread_px(anew)


def test_after_the_fog_they_are_carried_for_a_while_and_then_found_anew() -> None:
    one = Extractor(CAMERA, SlamConfig())
    foggy = one.extract(view(0, fog=True), DEPTH_M)
    clear = one.extract(view(1, fog=False), DEPTH_M)
    off, anew = (
        off_px(foggy, clear),
        off_px(foggy, Extractor(CAMERA, SlamConfig()).extract(view(1, fog=False), DEPTH_M)),
    )
    assert len(off) > len(anew)
    assert spread_px(off) < 0.5 * spread_px(anew)
    for number in range(2, 2 + _AFTER):
        clear = one.extract(view(number, fog=False), DEPTH_M)
    alone = Extractor(CAMERA, SlamConfig())
    alone.extract(view(number - 1, fog=False), DEPTH_M)  # the corners' thresholds follow the images before
    found = alone.extract(view(number, fog=False), DEPTH_M)
    same = (np.linalg.norm(clear.uv[:, None] - found.uv[None], axis=2).min(axis=1) < 1e-9).mean()
    assert same > 0.95


def test_another_scene_carries_nothing_over() -> None:
    one = Extractor(CAMERA, SlamConfig())
    one.extract(view(0, fog=True), DEPTH_M)
    turned = np.ascontiguousarray(view(1, fog=True)[::-1, ::-1])
    now, anew = one.extract(turned, DEPTH_M), Extractor(CAMERA, SlamConfig()).extract(turned, DEPTH_M)
    assert len(now) > 0.7 * len(anew)
    assert len(off_px(anew, now) + STEP_PX) > 0.4 * len(anew)


def test_a_pyramid_of_two_levels_carries_too() -> None:
    config = SlamConfig(levels=2)
    one = Extractor(CAMERA, config)
    frames = [one.extract(view(number, fog=True), DEPTH_M) for number in range(2)]
    off = off_px(*frames)
    assert len(off) > 100
    assert spread_px(off) < 0.3 * spread_px(
        off_px(*(Extractor(CAMERA, config).extract(view(n, fog=True), DEPTH_M) for n in (0, 1)))
    )


def test_places_below_a_pixel_and_beyond_the_edge() -> None:
    before, now = (stretch(view(number, fog=True)) for number in (0, 1))
    assert before is not None
    assert now is not None
    xy = np.array([[x, y] for x in range(60, WIDTH, 40) for y in range(60, HEIGHT, 40)], float)
    place, good = carried(before, now, xy)
    leaves = xy[:, 0] + STEP_PX[0] > WIDTH - 20.0
    assert not good[leaves].any()
    assert good[~leaves].mean() > 0.9
    assert np.median(np.linalg.norm(place[good] - xy[good] - STEP_PX, axis=1)) < 0.3
    nothing, none = carried(before, np.full_like(now, 128), xy)
    assert len(nothing) == len(xy)
    assert not none.any()


def test_near_ones_are_the_same_corner() -> None:
    taken = np.array([[10.0, 10.0], [50.0, 50.0]])
    xy = np.array([[13.0, 14.0], [50.0, 57.0], [90.0, 10.0]])
    assert apart(taken, xy, np.array([6.0, 6.0, 6.0])).tolist() == [False, True, True]
    assert apart(taken[:0], xy, np.ones(3)).all()
    assert len(apart(taken, xy[:0], np.ones(0))) == 0
