"""Rendered images against geometry, the sensor against its model, the files against each other."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.common.geometry import apply, inverse, level_camera
from services.simulator.camera import SimulatedCamera
from services.simulator.config import PathConfig, SensorConfig
from services.simulator.path import eased, reference_path, sample
from services.simulator.render import DEFAULT_INTRINSICS, Renderer, Rendering, halved
from services.simulator.scene import Floats, Ground, Scene, SceneTree
from services.simulator.sensor import GRAVITY_M_S2, Accelerometer, RgbdSensor
from services.simulator.warm import warm
from services.simulator.world import Floats32, World
from services.simulator.write import write_sequence

cv2.setNumThreads(1)

LEAN_RAD = math.radians(8.0)
TREE = SceneTree(
    x_m=3.0, y_m=0.2, z_m=0.0, axis=(0.0, math.sin(LEAN_RAD), math.cos(LEAN_RAD)), radius_m=0.12, seed=5, taper=0.01,
    bumps=0.02,
)  # fmt: skip
SCENE = Scene("made", 3, (TREE,), ground=Ground(slope_rad=0.1))
STRAIGHT = level_camera([0.0, 0.0, 1.5], 0.0)


@pytest.fixture(scope="module")
def world() -> World:
    warm()
    return World(SCENE)


def points_world(depth_m: Floats32, T: Floats, valid: NDArray[np.bool_]) -> Floats:
    k = DEFAULT_INTRINSICS
    v, u = np.nonzero(valid)
    z = depth_m[v, u].astype(float)
    return apply(T, np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1))


def test_depth_is_that_of_the_leaning_cylinder(world: World) -> None:
    depth = Renderer(world, DEFAULT_INTRINSICS).render(STRAIGHT).depth_m
    near = np.isfinite(depth) & (depth < 3.2)
    points = points_world(depth, STRAIGHT, near)
    points = points[(points[:, 2] > 0.6) & (points[:, 2] < 2.5)]
    assert len(points) > 5000
    axis = np.array(TREE.axis)
    offset = points - TREE.base
    height = offset @ axis * axis[2]
    radius = np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1)
    error = radius - TREE.mean_radius(height)
    assert abs(error.mean()) < 0.002  # the bumps' mean over the half that is seen
    assert np.abs(error).max() < 0.12 * 0.02 * 2.0 + 0.001


def test_depth_is_that_of_the_ground(world: World) -> None:
    depth = Renderer(world, DEFAULT_INTRINSICS).render(STRAIGHT).depth_m
    low = np.zeros(depth.shape, dtype=bool)
    low[380:, :200] = True
    points = points_world(depth, STRAIGHT, low)
    assert np.allclose(points[:, 2], SCENE.ground.height(points[:, 0], points[:, 1]), atol=1e-3)


def test_half_size_image_sees_the_same_rays(world: World) -> None:
    full = Renderer(world, DEFAULT_INTRINSICS).render(STRAIGHT).depth_m
    half = Renderer(world, halved(DEFAULT_INTRINSICS)).render(STRAIGHT).depth_m
    ground = slice(200, 236), slice(10, 100)
    mean = full.reshape(240, 2, 320, 2).mean(axis=(1, 3))
    assert np.allclose(half[ground], mean[ground], rtol=2e-3)


def test_texture_belongs_to_the_surface(world: World) -> None:
    renderer = Renderer(world, DEFAULT_INTRINSICS)
    here = renderer.render(STRAIGHT)
    colour, depth = here.colour.copy(), here.depth_m
    v, u = np.mgrid[300:460:4, 20:620:4]
    valid = np.zeros(depth.shape, dtype=bool)
    valid[v, u] = True
    points = points_world(depth, STRAIGHT, valid)
    T = level_camera([0.02, 0.05, 1.52], 0.03)
    there = apply(inverse(T), points)
    k = DEFAULT_INTRINSICS
    u2 = np.round(k.fx * there[:, 0] / there[:, 2] + k.cx).astype(int)
    v2 = np.round(k.fy * there[:, 1] / there[:, 2] + k.cy).astype(int)
    other = renderer.render(T).colour
    inside = (u2 >= 0) & (u2 < 640) & (v2 >= 0) & (v2 < 480)
    a = colour[v.ravel(), u.ravel()][inside].mean(axis=1)
    b = other[v2[inside], u2[inside]].mean(axis=1)
    shuffled = np.roll(b, 137)
    assert a.std() > 15.0  # there is something to see
    assert np.corrcoef(a, b)[0, 1] > 0.6
    assert abs(np.corrcoef(a, shuffled)[0, 1]) < 0.2


def plain(depth_m: float, shape: tuple[int, int] = (480, 640)) -> Rendering:
    return Rendering(np.full((*shape, 3), 100, dtype=np.uint8), np.full(shape, depth_m, dtype=np.float32))


@pytest.mark.parametrize("depth_m", [1.5, 3.0, 5.0])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_depth_noise_follows_the_model(depth_m: float, scale: float) -> None:
    config = SensorConfig(disparity_sigma_px=0.08)
    shape = (int(480 * scale), int(640 * scale))
    sensor = RgbdSensor(config, shape, scale, seed=3)
    images = [sensor.expose(plain(depth_m, shape), seq).depth for seq in range(12)]
    assert images[0].shape == (480, 640)
    z = np.where(np.stack(images) > 0, np.stack(images), np.nan) / 1000.0
    expected = depth_m**2 * 0.08 / (565.0 * 0.070)
    assert np.nanstd(z) == pytest.approx(expected, rel=0.1)
    assert np.nanmean(z) == pytest.approx(depth_m, abs=0.1 * expected)
    fixed = np.nanstd(np.nanmean(z, axis=0))
    assert fixed == pytest.approx(expected * math.sqrt(config.fixed_share + (1 - config.fixed_share) / 12), rel=0.15)
    assert 0.002 < np.mean(np.isnan(z)) < 0.03


def test_depth_noise_is_shared_by_neighbours() -> None:
    sensor = RgbdSensor(SensorConfig(dropout=0.0), (480, 640), seed=3)
    z = sensor.expose(plain(4.0), 0).depth.astype(float)
    z -= z.mean()
    near = np.mean(z[:, 1:] * z[:, :-1]) / np.mean(z**2)
    far = np.mean(z[:, 20:] * z[:, :-20]) / np.mean(z**2)
    assert near > 0.6
    assert abs(far) < 0.1


def test_edges_are_mixed_and_shadowed() -> None:
    depth = np.full((480, 640), 5.0, dtype=np.float32)
    depth[:, 300:360] = 2.0
    sensor = RgbdSensor(SensorConfig(disparity_sigma_px=0.03, dropout=0.0), (480, 640))
    z = sensor.expose(Rendering(np.zeros((480, 640, 3), dtype=np.uint8), depth), 0).depth / 1000.0
    shadow_px = 565 * 0.070 * (1 / 2.0 - 1 / 5.0)
    assert np.all(z[:, int(300 - shadow_px) + 2 : 299] == 0.0)
    mixed = (z > 2.2) & (z < 4.5)
    per_row = mixed[:, 350:370].sum(axis=1)
    assert 1.0 <= per_row.mean() <= 6.0
    assert not mixed[:, 320:340].any()
    assert not mixed[:, 380:].any()


def test_range_limits() -> None:
    sensor = RgbdSensor(SensorConfig(), (480, 640))
    share = {d: float(np.mean(sensor.expose(plain(d), 0).depth > 0)) for d in (0.3, 0.6, 5.9, 7.0, 9.0, math.inf)}
    assert share[0.3] == 0.0
    assert share[9.0] == 0.0
    assert share[math.inf] == 0.0
    assert share[0.6] > 0.95
    assert share[5.9] > 0.9
    assert 0.2 < share[7.0] < 0.8


def test_perfect_sensor_gives_plain_millimetres() -> None:
    sensor = RgbdSensor(SensorConfig(disparity_sigma_px=0.0), (480, 640))
    assert np.all(sensor.expose(plain(3.1234), 0).depth == 3123)


def test_images_repeat() -> None:
    first, second = (SimulatedCamera(World(SCENE), SensorConfig(), seed=4) for _ in range(2))
    second.look(level_camera([0.0, 0.0, 1.0], 1.0), 0)
    a, b = first.look(STRAIGHT, 7), second.look(STRAIGHT, 7)
    assert np.array_equal(a.colour, b.colour)
    assert np.array_equal(a.depth, b.depth)
    assert not np.array_equal(first.look(STRAIGHT, 8).depth, a.depth)


def test_orb_features_are_found_again(world: World) -> None:
    camera = SimulatedCamera(world, SensorConfig())
    orb = cv2.ORB_create(1000)  # type: ignore[attr-defined]
    poses = [level_camera([0.0, 0.0, 1.5], yaw) for yaw in (0.0, math.radians(2.0))]
    seen = [orb.detectAndCompute(cv2.cvtColor(camera.look(T, i).colour, cv2.COLOR_BGR2GRAY), None)
            for i, T in enumerate(poses)]  # fmt: skip
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(seen[0][1], seen[1][1])
    k = DEFAULT_INTRINSICS
    R = (inverse(poses[1]) @ poses[0])[:3, :3]
    good = 0
    for match in matches:
        (u, v), (u2, v2) = seen[0][0][match.queryIdx].pt, seen[1][0][match.trainIdx].pt
        x, y, z = R @ np.array([(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0])
        good += math.hypot(k.fx * x / z + k.cx - u2, k.fy * y / z + k.cy - v2) < 3.0
    assert good > 300


def test_accelerometer_points_up_at_rest() -> None:
    sensor = Accelerometer(SensorConfig(), seed=2)
    readings = np.array([sensor.measure(STRAIGHT[:3, :3], np.zeros(3)) for _ in range(400)])
    assert np.allclose(readings.mean(axis=0), [0.0, -GRAVITY_M_S2, 0.0], atol=0.35)
    assert readings.std(axis=0).mean() == pytest.approx(0.08, rel=0.15)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_easing_never_goes_back(a: float, b: float) -> None:
    low, high = sorted((a, b))
    assert eased(low) <= eased(high) + 1e-12
    assert eased(0.0) == 0.0
    assert eased(1.0) == pytest.approx(1.0)


def test_path_is_smooth_and_follows_the_reference() -> None:
    path = reference_path(SCENE)
    steps = [T for _, T in sample(path, 15.0)]
    moves = np.array([np.linalg.norm(b[:3, 3] - a[:3, 3]) for a, b in itertools.pairwise(steps)])
    turns = np.array([math.acos(min(1.0, (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2))
                      for a, b in itertools.pairwise(steps)])  # fmt: skip
    assert moves.max() * 15.0 < 0.65
    assert turns.max() * 15.0 < 0.62
    assert np.abs(np.diff(moves)).max() * 15.0**2 < 1.5
    assert steps[0][2, 3] == pytest.approx(0.1)
    heights = [T[2, 3] for T in steps]
    assert max(heights) == pytest.approx(1.5, abs=0.35)  # the ground rises toward the tree
    assert turns.sum() > 2.0 * math.pi
    end = steps[-1]
    axis_point = TREE.centre_at(float(end[2, 3]))
    assert math.hypot(*(axis_point - end[:3, 3])[:2]) == pytest.approx(0.95, abs=0.05)


def test_sequence_is_a_tum_folder_and_repeats(tmp_path: Path) -> None:
    slow = PathConfig(rest_s=0.2)
    for name in ("a", "b"):
        assert write_sequence(SCENE, tmp_path / name, frames=3, reduced=True, path_config=slow) == 3
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert all((tmp_path / "a" / f).read_bytes() == (tmp_path / "b" / f).read_bytes() for f in files)
    folder = tmp_path / "a"
    lines = (folder / "associations.txt").read_text().splitlines()
    assert len(lines) == 3
    stamp, rgb, _, depth = lines[1].split()
    assert stamp == "1.066667"
    colour, metric = cv2.imread(str(folder / rgb)), cv2.imread(str(folder / depth), cv2.IMREAD_UNCHANGED)
    assert colour is not None
    assert colour.shape == (480, 640, 3)
    assert metric is not None
    assert metric.dtype == np.uint16
    truth = json.loads((folder / "truth.json").read_text())
    assert truth["scene"] == "made"
    assert truth["trees"][0]["suitable"]
    first = np.array((folder / "groundtruth.txt").read_text().splitlines()[1].split(), dtype=float)
    assert np.allclose(first[1:4], 0.0)
    accel = np.loadtxt(folder / "accelerometer.txt")
    assert np.allclose(accel[:, 1:].mean(axis=0), [0.0, GRAVITY_M_S2, 0.0], atol=0.4)  # up is +y in TUM's files
