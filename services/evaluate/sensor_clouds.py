"""The same forest flights through different depth sensors: the clouds that the mapper fuses of what each measures."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.simulation import TrueTree
from services.detector.config import DetectorConfig
from services.detector.model import Views
from services.evaluate import detection_clouds as clouds
from services.evaluate.bench import code_version
from services.mapper.cloud import KeyframeCloud
from services.mapper.config import MapperConfig
from services.simulator.config import SensorConfig
from services.simulator.lidar import Lidar, LidarModel
from services.simulator.models import CAMERA_MODELS, settings_of
from services.simulator.sensor import RgbdSensor

_CODE = (
    *clouds.FUSION_CODE,
    "services.simulator.time_of_flight",
    "services.simulator.lidar",
    "services.evaluate.sensor_clouds",
)
_FARTHEST_M = 8.0
"""Depth beyond is left out: noise would draw in the background's trunks (from 11.5 m on), which are no part of the truth."""


@dataclass(frozen=True, slots=True)
class Rig:
    """A sensor on the aircraft, and how mapper and detector are set for it."""

    name: str
    sensor: SensorConfig | LidarModel
    far_m: float
    """Depth used up to here."""
    per_square_m: float = 0.0
    """Its noise law as the chain takes it: ``per_square_m z^2``, and ``floor_m`` whatever the range."""
    floor_m: float = 0.0
    technology: str = ""

    def mapper(self) -> MapperConfig:
        """Return the mapper's settings."""
        near_m = (
            settings_of(self.sensor).min_range_m if isinstance(self.sensor, SensorConfig) else self.sensor.min_range_m
        )
        return MapperConfig(
            min_range_m=near_m,
            max_range_m=min(self.far_m, _FARTHEST_M),
            range_noise_per_m=self.per_square_m + self.floor_m / 9.0,
        )

    def detector(self) -> DetectorConfig:
        """Return the detector's settings."""
        own = DetectorConfig()
        surface_m = float(np.hypot(own.surface_noise_m, self.floor_m))
        return DetectorConfig(range_noise_per_m=self.per_square_m, surface_noise_m=surface_m, map_drift_m=0.0)


def _stereo(name: str, technology: str, sensor: SensorConfig, far_m: float) -> Rig:
    s = settings_of(sensor)
    # steps of the disparity are noise of a twelfth of their square
    sigma_px = float(np.hypot(s.disparity_sigma_px, s.disparity_step_px / np.sqrt(12.0)))
    return Rig(name, sensor, far_m, per_square_m=sigma_px / (s.focal_px * s.baseline_m), technology=technology)


RIGS: tuple[Rig, ...] = (
    _stereo("Kinect 1", "structured light", SensorConfig(model="kinect1"), 4.0),
    Rig("Kinect 2", SensorConfig(model="kinect2"), 4.5, per_square_m=0.0003, floor_m=0.001, technology="time of flight"),
    _stereo("R200", "active stereo", SensorConfig(model="r200"), 6.0),
    _stereo("D435", "active stereo", SensorConfig(model="d435"), 6.0),
    _stereo("Bumblebee2", "passive stereo", SensorConfig(model="bumblebee2"), 10.0),
    Rig("VLP-16", LidarModel(), 100.0, floor_m=0.03, technology="LiDAR, 16 beams"),
)  # fmt: skip


@lru_cache(maxsize=1)
def _flight(name: str) -> clouds.Flight:
    return clouds.flown(name)


def sensor_cloud(name: str, rig: Rig, cache: Path) -> clouds.SceneCloud:
    """Return the fused cloud of a scene seen by a rig, from ``cache`` if it is there.

    Raises:
        InputError: for an unknown scene.
    """
    label = json.dumps([name, repr(rig), code_version(_CODE)])
    stem = f"{rig.name.lower().replace(' ', '')}-{name}-{zlib.crc32(label.encode()):08x}"
    path, truth = cache / f"{stem}.npz", cache / f"{stem}.json"
    if not path.exists() or not truth.exists():
        flight = _flight(name)
        clouds.save_parts(path, clouds.fuse_clouds(_keyframe_clouds(name, flight, rig), flight.poses, rig.mapper()))
        truth.write_text(json.dumps([tree.model_dump_json() for tree in flight.trees]), encoding="utf-8")
    points, index, origins, rotations, tan_half = clouds.load_parts(path)
    trees = tuple(TrueTree.model_validate_json(tree) for tree in json.loads(truth.read_text(encoding="utf-8")))
    views = Views(index, origins, rotations, tan_half)
    views = dataclasses.replace(views, max_range_m=rig.mapper().max_range_m)
    return clouds.SceneCloud(name, points, views, trees)


def _keyframe_clouds(name: str, flight: clouds.Flight, rig: Rig) -> Iterator[KeyframeCloud]:
    seed = zlib.crc32(f"{name} {rig.name}".encode())
    if isinstance(rig.sensor, LidarModel):
        lidar = Lidar(flight.world, dataclasses.replace(rig.sensor, max_range_m=rig.mapper().max_range_m), seed)
        for seq, T in enumerate(flight.poses_world):
            points = lidar.scan(T, seq)
            yield KeyframeCloud(points, np.zeros((len(points), 3), dtype=np.uint8))
        return
    k, config = CAMERA_MODELS[rig.sensor.model].intrinsics, rig.mapper()
    for image in clouds.depth_images(flight, _camera(rig.sensor, seed), k):
        yield clouds.as_cloud(image, k, config)


def _camera(sensor: SensorConfig, seed: int) -> RgbdSensor:
    k = CAMERA_MODELS[sensor.model].intrinsics
    return RgbdSensor(sensor, (k.height, k.width), seed=seed, intrinsics=k)


def depth_view(name: str, rig: Rig, keyframe: int) -> NDArray[np.uint16]:
    """Return what a rig's camera measures at one keyframe, (H, W) millimetres; a LiDAR's beams drawn into such an image."""
    flight = _flight(name)
    one = dataclasses.replace(flight, poses_world=(flight.poses_world[keyframe],))
    if isinstance(rig.sensor, SensorConfig):
        k = CAMERA_MODELS[rig.sensor.model].intrinsics
        return clouds.depth_images(one, _camera(rig.sensor, 1), k)[0]
    k = CAMERA_MODELS["own"].intrinsics
    points = Lidar(flight.world, rig.sensor, 1).scan(one.poses_world[0], 0)
    points = points[(points[:, 2] > 0.1) & (points[:, 2] < _FARTHEST_M)]
    u = np.round(k.fx * points[:, 0] / points[:, 2] + k.cx).astype(int)
    v = np.round(k.fy * points[:, 1] / points[:, 2] + k.cy).astype(int)
    inside = (u >= 1) & (u < k.width - 1) & (v >= 1) & (v < k.height - 1)
    out = np.zeros((k.height, k.width), dtype=np.uint16)
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            out[v[inside] + dv, u[inside] + du] = np.round(1000.0 * points[inside, 2])
    return out
