"""The preview: outlines where trunks are, nothing stale drawn, never too big."""

from __future__ import annotations

import time
from typing import Any, cast

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.camera import Intrinsics, RgbdFrame
from schemas.envelope import DecodeError
from schemas.navigation import Guidance, MissionState
from schemas.preview import PreviewImage
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, MISSION_GUIDANCE, MISSION_STATE, PREVIEW_IMAGE, SLAM_POSE, TREES_LIST
from schemas.trees import Target, Tree, TreeList
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.geometry import apply, inverse, level_camera, to_transform
from services.common.memory import Hub
from services.detector.refine.view import project
from services.preview.draw import Encoder, draw, scaled
from services.preview.overlay import overlay_of, trunk_outline
from services.preview.service import build
from tests.examples import all_messages

I = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)  # noqa: E741 - the field's letter
STAMP_NS = 5_000_000_000
T = level_camera((0.0, 0.0, 1.5), 0.0)


def example(kind: type) -> Any:
    return next(e for e in all_messages().values() if type(e) is kind)


def tree(number: int = 7, x_m: float = 3.0, y_m: float = 0.0, radius_m: float = 0.12) -> Tree:
    made: Tree = (
        example(TreeList)
        .trees[0]
        .model_copy(
            update={"id": number, "x_m": x_m, "y_m": y_m, "z_m": 0.0, "radius_m": radius_m, "axis": (0.0, 0.0, 1.0)}
        )
    )
    return made


def pose(**more: object) -> Pose:
    made: Pose = example(Pose).model_copy(
        update={"stamp_ns": STAMP_NS, "T_map_camera": to_transform(T), "status": "tracking", **more}
    )
    return made


def mission(**more: object) -> MissionState:
    made: MissionState = example(MissionState).model_copy(update={"stamp_ns": STAMP_NS, "target_tree_id": 7, **more})
    return made


def guidance(command: str, magnitude: float = 0.4, unit: str = "m") -> Guidance:
    made: Guidance = example(Guidance).model_copy(
        update={"stamp_ns": STAMP_NS, "command": command, "magnitude": magnitude, "unit": unit}
    )
    return made


def test_the_outline_is_as_wide_as_the_trunk() -> None:
    outline = trunk_outline(tree(), inverse(T), I)
    assert outline is not None
    xs = [u for u, _ in outline.corners]
    assert max(xs) - min(xs) == pytest.approx(500.0 * 0.24 / 3.0, abs=0.5)
    assert np.mean(xs) == pytest.approx(I.cx, abs=0.5)
    assert outline.corners[0][1] == pytest.approx(239.5 + 500.0 * 1.5 / 3.0, abs=0.5), "its foot on the ground"
    assert outline.corners[0][0] < outline.corners[1][0]


@pytest.mark.parametrize(("x_m", "y_m"), [(-3.0, 0.0), (9.0, 0.0), (3.0, 4.0), (0.1, 0.0)])
def test_what_is_behind_far_or_beside_is_not_drawn(x_m: float, y_m: float) -> None:
    assert trunk_outline(tree(x_m=x_m, y_m=y_m), inverse(T), I) is None


def middle_at(corners: tuple[tuple[float, float], ...], v: float) -> float:
    """Return the column midway between an outline's edges in the row ``v``."""
    high = len(corners) // 2
    right, left = np.array(corners[1 : high + 1]), np.array(corners[:1] + corners[:high:-1])
    return float(np.mean([np.interp(-v, -edge[:, 1], edge[:, 0]) for edge in (left, right)]))


@pytest.mark.parametrize("lens", [{"k1": 0.26}, {"k1": 0.26, "k2": -0.95, "p1": -0.005, "p2": 0.0026, "k3": 1.16}])
@pytest.mark.parametrize(("x_m", "y_m"), [(3.0, 1.6), (3.0, -1.6), (1.2, 0.6)])
def test_the_outline_stands_where_the_lens_shows_the_trunk(lens: dict[str, float], x_m: float, y_m: float) -> None:
    bent = I.model_copy(update=lens)
    outline = trunk_outline(
        tree(x_m=x_m, y_m=y_m, radius_m=0.04), inverse(T), bent
    )  # thin: edges lie evenly about its axis
    assert outline is not None
    for height_m in (1.2, 1.5, 1.8):  # of the camera at 1.5 m the refiner tells the column
        at = project(apply(inverse(T), np.array([[x_m, y_m, height_m]])), bent)[0]
        assert middle_at(outline.corners, float(at[1])) == pytest.approx(at[0], abs=1.0)


def test_what_lies_beyond_the_picture_is_not_folded_back_into_it() -> None:
    barrel = I.model_copy(update={"k1": -0.3})
    outline = trunk_outline(tree(x_m=0.6), inverse(T), barrel)  # its foot is 68 degrees below the axis
    assert outline is not None
    rows = [v for _, v in outline.corners]
    assert rows[0] > I.height
    assert rows[len(rows) // 2] < 0.0
    assert rows[1 : len(rows) // 2 + 1] == sorted(rows[1 : len(rows) // 2 + 1], reverse=True)


@given(st.floats(-8, 8), st.floats(-8, 8), st.floats(-3.1, 3.1))
@settings(max_examples=60, deadline=None)
def test_every_outline_lies_around_its_trunk(x_m: float, y_m: float, yaw_rad: float) -> None:
    seen_from = level_camera((0.0, 0.0, 1.5), yaw_rad)
    outline = trunk_outline(tree(x_m=x_m, y_m=y_m), inverse(seen_from), I)
    if outline is None:
        return
    point = apply(inverse(seen_from), np.array([[x_m, y_m, 1.0]]))[0]
    u = I.fx * point[0] / point[2] + I.cx
    xs = [p[0] for p in outline.corners]
    assert min(xs) - 1e-6 <= u <= max(xs) + 1e-6


def test_colours_mean_what_the_reference_says() -> None:
    target: Target = example(Target).model_copy(update={"range_m": 3.0, "radius_m": 0.12, "image_x_px": 400.0})
    overlay = overlay_of(I, pose(), (tree(), tree(8, y_m=0.8)), target, mission(), guidance("turn_left", 0.5, "rad"))
    assert overlay.mapped is not None
    assert overlay.seen is not None
    assert np.mean([u for u, _ in overlay.seen.corners]) == pytest.approx(400.0)
    assert len(overlay.others) == 1
    assert overlay.arrow == (-1.0, 0.0)
    assert overlay.headline == "turn left 29 deg"
    image = np.full((480, 640, 3), 90, np.uint8)
    draw(image, overlay, 1.0)
    b, g, r = (image[..., k].astype(int) for k in range(3))
    assert ((r > 200) & (g < 80) & (b < 80)).sum() > 300, "a red arrow"
    assert ((g > 180) & (r < 110) & (b < 110)).sum() > 300, "a green outline"
    assert ((b > 200) & (r < 120)).sum() > 300, "a blue outline"
    assert not overlay.docked


def test_docked_is_a_green_border() -> None:
    image = np.full((480, 640, 3), 90, np.uint8)
    draw(image, overlay_of(I, pose(), (), None, mission(state="docked"), guidance("docked", 0.0, "")), 1.0)
    assert (image[240, 3] == (60, 220, 60)).all()


def test_trouble_is_told_and_nothing_guessed() -> None:
    lost = pose(status="lost", T_map_camera=None, covariance=None, keyframe_id=None, T_keyframe_camera=None)
    overlay = overlay_of(I, lost, (tree(),), None, mission(), None)
    assert overlay.mapped is None
    assert overlay.others == ()
    assert overlay.warning == "slam lost"
    assert overlay_of(I, None, (tree(),), None, None, None).warning == "no pose"
    assert overlay_of(I, pose(), (), None, mission(failsafe="target_lost"), None).warning == "target lost"


@pytest.mark.parametrize("max_bytes", [60_000, 20_000, 10_000])
def test_no_picture_is_ever_too_big(max_bytes: int) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (360, 480, 3)).astype(np.uint8)
    encoder = Encoder(max_bytes, 80)
    for _ in range(3):
        data = encoder.encode(noise)
        assert len(data) <= max_bytes
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None
    flat = np.full_like(noise, 128)
    for _ in range(40):
        encoder.encode(flat)
    assert encoder.quality == 80, "the quality comes back when pictures are easy again"


def test_small_pictures_are_not_scaled_up() -> None:
    image, factor = scaled(np.zeros((120, 160, 3), np.uint8), 480)
    assert image.shape == (120, 160, 3)
    assert factor == 1.0


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", b"GIF89a", b"\xff\xd8\xff" + bytes(70_000) + b"\xff\xd9"])
def test_what_is_no_small_jpeg_is_refused(data: bytes) -> None:
    with pytest.raises(DecodeError):
        PreviewImage.from_bytes(data)


def frame(stamp_ns: int, colour: bytes | None = None) -> RgbdFrame:
    body = bytes(640 * 480 * 3) if colour is None else colour
    encoding = "bgr8" if colour is None else "jpeg"
    return RgbdFrame(stamp_ns, 0, I, body, bytes(640 * 480 * 2), colour_encoding=encoding)  # type: ignore[arg-type]


def test_pictures_only_while_somebody_looks_one_per_frame_and_bad_ones_are_counted() -> None:
    hub = Hub(TreedockConfig())
    build(cast("Context", context := hub.context("preview")))
    source = hub.context("camera")
    seen: list[PreviewImage] = []

    def feed(made: RgbdFrame) -> None:
        source.publish(CAMERA_RGBD, made)
        hub.run()
        hub.advance_to(hub.clock.now_ns() + 250_000_000)

    feed(frame(STAMP_NS))
    assert "pictures" not in context.health.counters
    hub.context("station").on(PREVIEW_IMAGE, seen.append)
    source.publish(SLAM_POSE, pose())
    source.publish(TREES_LIST, example(TreeList).model_copy(update={"map_id": pose().map_id, "trees": (tree(),)}))
    source.publish(MISSION_STATE, mission())
    source.publish(MISSION_GUIDANCE, guidance("toward"))
    feed(frame(STAMP_NS))
    assert len(seen) == 1
    hub.advance_to(hub.clock.now_ns() + 10**9)
    assert len(seen) == 1, "no frame, no picture"
    with_tree = cv2.imdecode(np.frombuffer(seen[0].jpeg, np.uint8), cv2.IMREAD_COLOR)
    feed(frame(STAMP_NS + 5 * 10**9))
    stale = cv2.imdecode(np.frombuffer(seen[1].jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert with_tree is not None
    assert stale is not None
    assert int(with_tree.max(axis=2)[60:300].sum()) > 3 * int(stale.max(axis=2)[60:300].sum()), (
        "old outlines are not drawn"
    )
    feed(frame(STAMP_NS, b"\xff\xd8\xff nonsense"))
    assert context.health.counters["dropped_bad_frames"] == 1
    assert len(seen) == 2


@pytest.mark.parametrize("k1", [0.0, 0.26])
def test_a_forest_of_five_hundred_trees_costs_no_more_than_a_frame_may(k1: float) -> None:
    lens = I.model_copy(update={"k1": k1})
    forest = tuple(tree(k, 2.0 + 0.01 * k, -3.0 + 0.012 * k) for k in range(500))
    spent_s = []
    for _ in range(5):
        begin_s = time.thread_time()
        shown = overlay_of(lens, pose(), forest, None, None, None)
        spent_s.append(time.thread_time() - begin_s)
    assert len(shown.others) > 100
    assert min(spent_s) < 0.02  # 2.3 ms measured; one tree after the other took 39
