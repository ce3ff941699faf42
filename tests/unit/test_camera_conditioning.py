from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from schemas.camera import Intrinsics, RgbdFrame
from services.camera.codecs import FrameError, decode_colour, decode_depth_m, decode_depth_raw, encode_depth, recode
from services.camera.conditioning import Conditioner, undistorted
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.depth.geometry import register
from services.camera.sources import open_recording
from services.camera.sources.camera_json import read_camera
from services.common.errors import InputError
from tests.camera_data import CAMERA, depth_image, frame, write_tum

ALL = DepthConfig(drop_mixed=True, bilateral=True, fill_holes=True, temporal=True, undistort=True)
NONE = DepthConfig(drop_mixed=False, bilateral=False, fill_holes=False, temporal=False)
BENT = Intrinsics(
    width=160, height=120, fx=120.0, fy=121.0, cx=79.0, cy=60.5, k1=0.25, k2=-0.3, p1=0.002, p2=-0.003, k3=0.1
)


def config(depth: DepthConfig, **more: Any) -> CameraConfig:
    return CameraConfig(min_range_m=0.3, max_range_m=7.0, depth=depth, **more)


def test_range_alone_keeps_every_value_exactly() -> None:
    out = Conditioner(config(NONE)).apply(frame(3))
    wanted = depth_image(3)
    wanted[(wanted < 1500) | (wanted > 35000)] = 0
    assert np.array_equal(decode_depth_raw(out), wanted)
    assert out.colour == frame(3).colour


def test_every_stage_is_switched_by_the_configuration_and_timed() -> None:
    bent = dataclasses.replace(frame(1), intrinsics=frame(1).intrinsics.model_copy(update={"k1": 0.1}))
    conditioner = Conditioner(config(ALL))
    conditioner.apply(bent)
    assert set(conditioner.stage_ms) == {
        "decode", "undistort", "grey", "range", "mixed", "bilateral", "fill", "temporal",
    }  # fmt: skip
    for stage, name in (
        ("drop_mixed", "mixed"),
        ("bilateral", "bilateral"),
        ("fill_holes", "fill"),
        ("temporal", "temporal"),
    ):
        only = Conditioner(config(NONE.model_copy(update={stage: True})))
        only.apply(bent)
        assert name in only.stage_ms
        assert set(only.stage_ms) <= {"decode", "grey", "range", name}


def test_a_compressed_frame_is_conditioned_alike() -> None:
    plain = Conditioner(config(ALL)).apply(recode(frame(2), "jpeg", "png", 95))
    assert (plain.colour_encoding, plain.depth_encoding) == ("bgr8", "z16")
    with pytest.raises(FrameError, match="frame 1"):
        Conditioner(config(ALL)).apply(dataclasses.replace(frame(1), depth=b"xx"))


def test_mixed_pixels_alone_change_no_other_value() -> None:
    depth = np.full((32, 48), 10_000, np.uint16)
    depth[:, 24:] = 20_000
    depth[:, 24] = 14_000
    image = dataclasses.replace(frame(1), depth=encode_depth(depth, "z16"))
    out = decode_depth_raw(Conditioner(config(NONE.model_copy(update={"drop_mixed": True}))).apply(image))
    assert np.all(out[:, 24] == 0)
    kept = out > 0
    assert np.array_equal(out[kept], depth[kept])
    assert kept.mean() > 0.85


def bent_frame() -> tuple[RgbdFrame, np.ndarray]:
    """Return a frame through a bent lens of a tilted plane with a pattern, and the plane (n, d): n . p = d."""
    normal, distance = np.array([0.2, -0.1, 1.0]), 2.0
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    K = np.array([[BENT.fx, 0, BENT.cx], [0, BENT.fy, BENT.cy], [0, 0, 1]])
    lens = np.array([BENT.k1, BENT.k2, BENT.p1, BENT.p2, BENT.k3])
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    rays = np.asarray(cv2.undistortPoints(np.stack([u, v], -1).reshape(-1, 1, 2), K, lens, None, None, None, criteria))
    x, y = rays[:, 0, 0].reshape(u.shape), rays[:, 0, 1].reshape(u.shape)
    z = distance / (normal[0] * x + normal[1] * y + 1.0)
    bright = (127 + 100 * np.sin(20 * x * z) * np.cos(20 * y * z)).astype(np.uint8)
    colour = np.repeat(bright[..., None], 3, axis=2).tobytes()
    depth = encode_depth(np.rint(z * 1000).astype(np.uint16), "z16")
    return RgbdFrame(0, 0, BENT, colour, depth), np.array([*normal, distance])


def test_undistorted_depth_lies_on_the_plane_that_a_pinhole_would_see() -> None:
    image, plane = bent_frame()
    out = undistorted(image)
    assert not out.intrinsics.distorted
    i = out.intrinsics
    z = decode_depth_m(out).astype(np.float64)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    points = np.stack([(u - i.cx) / i.fx * z, (v - i.cy) / i.fy * z, z], axis=-1)
    error = np.abs(points @ plane[:3] - plane[3])[z > 0]
    assert (z > 0).mean() > 0.85
    assert np.percentile(error, 99) < 0.006, "nearest neighbour: half a pixel of the plane's slope"
    straight = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy], axis=-1) * z[..., None]
    wanted = 127 + 100 * np.sin(20 * straight[..., 0]) * np.cos(20 * straight[..., 1])
    grey = decode_colour(out)[..., 0].astype(float)
    assert np.median(np.abs(grey - wanted)[z > 0]) < 6.0


def test_registration_fits_a_bent_colour_image() -> None:
    """The same plane, seen by a straight depth camera beside the bent colour camera."""
    straight = Intrinsics(width=160, height=120, fx=110.0, fy=110.0, cx=80.0, cy=60.0)
    image, plane = bent_frame()
    T_colour_depth = np.eye(4)
    T_colour_depth[0, 3] = 0.03
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    x, y = (u - 80.0) / 110.0, (v - 60.0) / 110.0
    # the plane in the depth camera: n . (p + t) = d
    z = (plane[3] - plane[0] * 0.03) / (plane[0] * x + plane[1] * y + plane[2])
    out = register(z.astype(np.float32), straight, BENT, T_colour_depth)
    true = decode_depth_m(image)
    both = out > 0
    assert both.mean() > 0.6
    assert np.percentile(np.abs(out - true)[both], 95) < 0.01


def test_a_recording_with_a_depth_camera_of_its_own_is_registered(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 2)
    for path in (folder / "depth").iterdir():
        path.write_bytes(encode_depth(np.full((16, 24), 2000, np.uint16), "png"))
    depth_camera = {"width": 24, "height": 16, "fx": 20.0, "fy": 20.0, "cx": 11.5, "cy": 7.5, "depth_scale": 1000.0}
    T = np.eye(4)
    T[2, 3] = 0.5
    file = tmp_path / "depth.json"
    file.write_text(json.dumps({**depth_camera, "T_colour_depth": T.tolist()}))
    frames = [f for f in open_recording(folder, config(NONE, depth_camera_file=str(file))) if isinstance(f, RgbdFrame)]
    assert len(frames) == 2
    metres = decode_depth_m(frames[0])
    assert metres.shape == (32, 48)
    assert np.all((metres == 0) | (np.abs(metres - 2.5) < 1e-3))
    assert (metres > 0).mean() > 0.5
    file.write_text(json.dumps(depth_camera))
    with pytest.raises(InputError, match=r"depth\.json: T_colour_depth missing"):
        open_recording(folder, config(NONE, depth_camera_file=str(file)))


@pytest.mark.parametrize(
    "T", [1, [[1, 0], [0, 1]], np.diag([1.0, 1, 1.1, 1]).tolist(), np.diag([1.0, 1, -1, 1]).tolist(), "x"]
)
def test_a_transform_that_is_none_is_refused(tmp_path: Path, T: object) -> None:
    file = tmp_path / "camera.json"
    file.write_text(json.dumps({**CAMERA, "T_body_camera": T}))
    with pytest.raises(InputError, match=r"camera\.json: T_body_camera: expected four rows"):
        read_camera(file)
    file.write_text(json.dumps({**CAMERA, "T_body_camera": np.eye(4).tolist(), "calibration": {"any": 1}}))
    found = read_camera(file).T_body_camera
    assert found is not None
    assert np.array_equal(found, np.eye(4))


def test_mapper_refiner_and_slam_honour_the_lens_themselves() -> None:
    """What makes resampling needless: each puts the bent camera's pixels on the true plane."""
    from services.detector.refine.view import ray_table
    from services.mapper.cloud import pixel_rays
    from services.slam.config import SlamConfig
    from services.slam.features import Extractor

    image, plane = bent_frame()
    z = decode_depth_m(image).astype(np.float64)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    straight = Extractor(BENT, SlamConfig()).undistort(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(120, 160, 2)
    mapped = pixel_rays(BENT)
    seen = {
        "mapper": (mapped[..., 0], mapped[..., 1]), "refiner": ray_table(BENT),
        "slam": ((straight[..., 0] - BENT.cx) / BENT.fx, (straight[..., 1] - BENT.cy) / BENT.fy),
        "nobody": ((u - BENT.cx) / BENT.fx, (v - BENT.cy) / BENT.fy),
    }  # fmt: skip
    off = {}
    for name, (x, y) in seen.items():
        points = np.stack([x * z, y * z, z], axis=-1)
        off[name] = float(np.nanmax(np.abs(points @ plane[:3] - plane[3])))
    assert max(off["mapper"], off["refiner"], off["slam"]) < 0.001, off
    assert off["nobody"] > 0.02
