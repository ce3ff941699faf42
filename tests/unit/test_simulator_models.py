"""Cameras that one could buy, as the simulator has them: image, margins, noise law, sunlight."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from services.common.geometry import apply, inverse, level_camera
from services.simulator.camera import SimulatedCamera
from services.simulator.config import SensorConfig, SensorName
from services.simulator.lidar import Lidar, LidarModel
from services.simulator.models import CAMERA_MODELS, settings_of
from services.simulator.render import Rendering
from services.simulator.scene import Scene, SceneTree
from services.simulator.sensor import RgbdSensor
from services.simulator.time_of_flight import axial_sigma_m
from services.simulator.world import World

TREE = SceneTree(x_m=2.5, y_m=0.0, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=0.15, seed=5, bumps=0.0, taper=0.0)
LOOKING = level_camera([0.0, 0.0, 1.5], 0.0)


@pytest.fixture(scope="module")
def world() -> World:
    return World(Scene("one", 3, (TREE,)))


def depth_of_plane(model: SensorName, depth_m: float, frames: int = 8) -> NDArray[np.float64]:
    """Return (frames, H, W) metres of a wall, NaN without data."""
    camera = CAMERA_MODELS[model].intrinsics
    shape = (camera.height, camera.width)
    sensor = RgbdSensor(SensorConfig(model=model), shape, seed=3, intrinsics=camera)
    wall = Rendering(np.full((*shape, 3), 100, dtype=np.uint8), np.full(shape, depth_m, dtype=np.float32))
    images = np.stack([sensor.expose(wall, seq).depth for seq in range(frames)])
    return np.where(images > 0, images, np.nan) / 1000.0


@pytest.mark.parametrize(
    ("model", "sigma_m"),
    [
        ("kinect1", 9.0 * 0.001425),
        ("kinect2", 0.0027),
        ("r200", 9.0 * 0.08 / (565.0 * 0.070)),
        ("d435", 9.0 * 0.08 / (433.0 * 0.050)),
        ("bumblebee2", 9.0 * 0.2 / (492.7 * 0.120)),
    ],
)
def test_noise_at_three_metres_is_the_published_law(model: SensorName, sigma_m: float) -> None:
    z = depth_of_plane(model, 3.0)
    # the Kinect's steps add a twelfth of their square
    expected = math.hypot(sigma_m, 9.0 * 0.00285 / math.sqrt(12.0)) if model == "kinect1" else sigma_m
    assert np.nanstd(z) == pytest.approx(expected, rel=0.12)
    assert np.nanmean(z) == pytest.approx(3.0, abs=0.3 * expected)


def test_the_first_kinect_measures_in_steps() -> None:
    z = depth_of_plane("kinect1", 3.0, 1)
    steps = np.unique(z[np.isfinite(z)])
    assert len(steps) < 12
    assert np.diff(steps).min() == pytest.approx(0.0258, rel=0.15)  # z^2 / (f B) times an eighth of a pixel


def test_time_of_flight_noise_grows_with_the_slope() -> None:
    assert axial_sigma_m(2.0, 0.0) == pytest.approx(0.0017)
    assert axial_sigma_m(2.0, 3.0) > 1.5 * axial_sigma_m(2.0, 0.0)
    assert axial_sigma_m(2.0, 1e9) < 0.05


def test_the_r200_has_margins_without_depth(world: World) -> None:
    camera = SimulatedCamera(world, SensorConfig(model="r200"))
    assert (camera.intrinsics.fx, camera.intrinsics.fy) == (457.0, 609.0)
    depth = camera.look(LOOKING, 0).depth
    columns = np.flatnonzero((depth > 0).any(axis=0))
    assert columns[0] == pytest.approx(61, abs=2)
    assert columns[-1] == pytest.approx(578, abs=2)


def test_a_squeezed_image_gives_the_same_trunk(world: World) -> None:
    camera = SimulatedCamera(world, SensorConfig(model="r200", disparity_sigma_px=0.0))
    depth = camera.look(LOOKING, 0).depth / 1000.0
    k = camera.intrinsics
    v, u = np.nonzero((depth > 0.0) & (depth < 2.6))
    z = depth[v, u]
    points = apply(LOOKING, np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1))
    trunk = points[(points[:, 2] > 0.5) & (points[:, 2] < 2.0)]
    assert len(trunk) > 5000
    from_axis = np.hypot(trunk[:, 0] - TREE.x_m, trunk[:, 1] - TREE.y_m)
    assert np.abs(from_axis - TREE.radius_m).max() < 0.004
    assert np.ptp(trunk[:, 2]) > 1.3


def test_reduced_rendering_keeps_margins_and_size(world: World) -> None:
    camera = SimulatedCamera(world, SensorConfig(model="r200"), reduced=True)
    depth = camera.look(LOOKING, 0).depth
    assert depth.shape == (480, 640)
    assert not depth[:, :58].any()
    assert depth[:, 66:].any()


def test_what_the_user_sets_beats_the_models_figure() -> None:
    settings = settings_of(SensorConfig(model="d435", disparity_sigma_px=0.03))
    assert settings.disparity_sigma_px == 0.03
    assert settings.baseline_m == 0.050


def test_sunlight(world: World) -> None:
    blind = SimulatedCamera(world, SensorConfig(model="kinect1", sunlight=True))
    assert not blind.look(LOOKING, 0).depth.any()
    sees = SimulatedCamera(world, SensorConfig(model="r200", sunlight=True))
    assert sees.look(LOOKING, 0).depth.any()
    with pytest.raises(ValidationError, match="not modelled"):
        SensorConfig(model="kinect2", sunlight=True)


def test_the_lidar_sees_the_trunk_in_rings(world: World) -> None:
    lidar = Lidar(world, LidarModel(range_sigma_m=0.0))
    points = apply(LOOKING, lidar.scan(LOOKING, 0).astype(np.float64))
    trunk = points[np.hypot(points[:, 0] - TREE.x_m, points[:, 1] - TREE.y_m) < 0.16]
    trunk = trunk[(trunk[:, 2] > 0.2) & (trunk[:, 2] < 2.9)]
    assert np.abs(np.hypot(trunk[:, 0] - 2.5, trunk[:, 1]) - 0.15).max() < 0.004
    elevation = np.degrees(np.arctan2(trunk[:, 2] - 1.5, np.hypot(trunk[:, 0], trunk[:, 1])))
    rings = np.unique(np.round(elevation))
    assert list(np.diff(rings)) == [2.0] * (len(rings) - 1)
    assert len(rings) >= 12
    behind = apply(inverse(LOOKING), points)[:, 2] < -1.0
    assert behind.any()  # all round
    noisy = Lidar(world, LidarModel(), seed=1)
    assert np.array_equal(noisy.scan(LOOKING, 4), noisy.scan(LOOKING, 4))
    assert not np.array_equal(noisy.scan(LOOKING, 4)[:100], noisy.scan(LOOKING, 5)[:100])
