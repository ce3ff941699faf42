"""Fused clouds of simulated scenes for the detector's benchmark: few keyframes, rendered honestly, fused by the mapper.

A whole recording of a scene costs a minute of processor time. The detector sees only the keyframes' depth, so only
those are rendered: about 35 along the reference's path (rise, turn, approach), with the sensor's own noise, holes and
mixed pixels, then filtered and fused by the mapper's core and read back through the detector's own map store. Colour and
slam are left out: poses are true, or (drift) wrong by errors like those measured of slam.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from schemas.mapping import Submap
from schemas.simulation import TrueTree
from services.common.geometry import exp_rotation, inverse
from services.detector.map_store import MapStore
from services.detector.model import Views
from services.evaluate.bench import code_version

if TYPE_CHECKING:
    from services.mapper.cloud import KeyframeCloud
    from services.mapper.config import MapperConfig
    from services.simulator.sensor import RgbdSensor
    from services.simulator.world import World

Floats = NDArray[np.float64]

STEP_M = 0.3
STEP_RAD = 0.26
"""A keyframe every 0.3 m or 15 degrees of the path."""
_RATE_HZ = 15.0
_STAMP_NS = 66_666_667
_SIMULATOR = (
    "services.common.geometry",
    *(f"services.simulator.{name}" for name in (
        "scene", "planting", "catalogue", "meshes", "world", "render", "sensor", "models", "path", "truth",
    )),
)  # fmt: skip
FUSION_CODE = (
    *_SIMULATOR,
    "services.mapper.cloud",
    "services.mapper.config",
    "services.mapper.dense_map",
    "services.mapper.ground_grid",
    "services.mapper.voxel_table",
)


@dataclass(frozen=True, slots=True)
class Drift:
    """Errors of keyframe poses, as measured of slam on rendered flights (docs/decisions/chain-errors.md)."""

    tilt_rad: float = 0.013
    """Standard deviation of the map's lean, per horizontal axis."""
    slow_m: float = 0.006
    """Of the position's slow wandering, per axis."""
    slow_rad: float = 0.0025
    """Of the yaw's slow wandering."""
    white_m: float = 0.002
    white_rad: float = 0.0006
    memory: float = 0.93
    """Correlation of the slow part from one keyframe to the next."""


@dataclass(frozen=True, slots=True)
class SceneCloud:
    """What the detector gets, and the truth."""

    name: str
    points_m: NDArray[np.float32]
    """(N, 3), map frame."""
    views: Views
    trees: tuple[TrueTree, ...]


@dataclass(frozen=True, slots=True)
class _Shots:
    """The sensed depth images of a scene's keyframes."""

    depth: NDArray[np.uint16]
    """(K, H, W) millimetres."""
    poses: Floats
    """(K, 4, 4) T_map_camera, true."""
    trees: tuple[TrueTree, ...]


def scene_cloud(name: str, cache: Path, drift: Drift | None = None) -> SceneCloud:
    """Return the fused cloud of a scene (a name of the catalogue or random-KIND-SEED), from ``cache`` if it is there.

    Raises:
        InputError: for an unknown scene.
    """
    label = json.dumps([name, None if drift is None else repr(drift), code_version(FUSION_CODE)])
    path, shown = cache / f"cloud-{zlib.crc32(label.encode()):08x}-{name}.npz", _shots_path(name, cache)
    if not path.exists() or not shown.exists():
        shots = _cached_shots(name, cache)
        poses = shots.poses if drift is None else wrong_poses(shots.poses, drift, zlib.crc32(name.encode()))
        store = fuse(shots.depth, poses)
        save_parts(path, store)
    points, index, origins, rotations, tan_half = load_parts(path)
    with np.load(shown) as held:  # only the truth is unpacked
        trees = _trees(str(held["trees"]))
    return SceneCloud(name, points, Views(index, origins, rotations, tan_half), trees)


_Parts = tuple[NDArray[np.float32], NDArray[np.int32], Floats, Floats, tuple[float, float]]


def fuse(depth: NDArray[np.uint16], poses: Floats) -> _Parts:
    """Return points, view index, origins, rotations and field of view of depth images (K, H, W) at poses (K, 4, 4)."""
    from services.mapper.config import MapperConfig
    from services.simulator.render import DEFAULT_INTRINSICS

    config = MapperConfig()
    return fuse_clouds((as_cloud(image, DEFAULT_INTRINSICS, config) for image in depth), poses, config)


def as_cloud(image_mm: NDArray[np.uint16], intrinsics: Intrinsics, config: MapperConfig) -> KeyframeCloud:
    """Return the mapper's points of a depth image (H, W)."""
    from services.mapper.cloud import keyframe_cloud, pixel_rays

    return keyframe_cloud(image_mm.astype(np.float32) * np.float32(0.001), None, pixel_rays(intrinsics), config)


def fuse_clouds(clouds: Iterable[KeyframeCloud], poses: Floats, config: MapperConfig) -> _Parts:
    """Return the same parts of keyframes' clouds at poses (K, 4, 4)."""
    from services.mapper.dense_map import DenseMap

    dense = DenseMap(config)
    dense.reset("bench")
    store = MapStore()
    store.clear("bench")
    for k, (cloud, T) in enumerate(zip(clouds, poses, strict=True)):
        dense.add(k, k * _STAMP_NS, cloud, T)
    for s in dense.submaps.values():
        store.take(
            Submap(
                map_id="bench", submap_id=s.submap_id, version=1, graph_version=1, stamp_ns=s.stamp_ns, T_map_submap=s.T_map_submap,
                points_m=s.points_m, view=np.zeros(len(s.points_m), dtype=np.uint16),
                origins_m=np.zeros((1, 3), dtype=np.float32), colour=np.zeros((0, 3), dtype=np.uint8),
            )
        )  # fmt: skip
    points, views = store.assemble()
    rotations = views.rotations if views.rotations is not None else np.zeros((0, 3, 3))
    return points, views.index, views.origins_m, rotations, views.tan_half or (0.0, 0.0)


def keyframe_points(name: str, cache: Path) -> tuple[NDArray[np.float32], Views]:
    """Return the filtered points of all keyframes of a scene, not thinned against each other, each with its view."""
    from services.mapper.cloud import keyframe_cloud, pixel_rays
    from services.mapper.config import MapperConfig
    from services.simulator.render import DEFAULT_INTRINSICS

    shots = _cached_shots(name, cache)
    config, rays = MapperConfig(), pixel_rays(DEFAULT_INTRINSICS)
    points, index = [], []
    for k, (image, T) in enumerate(zip(shots.depth, shots.poses, strict=True)):
        local = keyframe_cloud(image.astype(np.float32) * np.float32(0.001), None, rays, config).points_m
        points.append((local @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
        index.append(np.full(len(local), k, dtype=np.int32))
    views = Views(np.concatenate(index), shots.poses[:, :3, 3].copy(), shots.poses[:, :3, :3].copy(), (0.64, 0.48))
    return np.concatenate(points), views


def raw_points(name: str, cache: Path, count: int) -> tuple[NDArray[np.float32], Views]:
    """Return ``count`` points of a scene's first keyframes as the sensor gave them, 0.5 to 6 m away, each with its view."""
    from services.mapper.cloud import pixel_rays
    from services.simulator.render import DEFAULT_INTRINSICS

    shots = _cached_shots(name, cache)
    rays = pixel_rays(DEFAULT_INTRINSICS).astype(np.float64).reshape(-1, 2)
    directions = np.column_stack([rays, np.ones(len(rays))])
    points, index, have = [], [], 0
    for k, (image, T) in enumerate(zip(shots.depth, shots.poses, strict=True)):
        depth = image.astype(np.float64).reshape(-1, 1) * 0.001
        near = ((depth > 0.5) & (depth < 6.0))[:, 0]
        local = (depth * directions)[near]
        points.append((local @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
        index.append(np.full(len(local), k, dtype=np.int32))
        have += len(local)
        if have >= count:
            break
    views = Views(
        np.concatenate(index)[:count], shots.poses[:, :3, 3].copy(), shots.poses[:, :3, :3].copy(), (0.64, 0.48)
    )
    return np.concatenate(points)[:count], views


def wrong_poses(poses: Floats, drift: Drift, seed: int) -> Floats:
    """Return poses (K, 4, 4) with a lean of the whole map, a slow wandering and white noise."""
    rng = np.random.default_rng([seed, 707])
    lean = exp_rotation(np.array([*rng.normal(0.0, drift.tilt_rad, 2), 0.0]))
    sigma = np.array([drift.slow_m, drift.slow_m, drift.slow_m, drift.slow_rad])
    slow = np.zeros(4)
    out = poses.copy()
    for T in out:
        slow = drift.memory * slow + np.sqrt(1.0 - drift.memory**2) * sigma * rng.normal(size=4)
        turn = exp_rotation(np.array([0.0, 0.0, slow[3]]) + rng.normal(0.0, drift.white_rad, 3))
        T[:3, :3] = turn @ lean @ T[:3, :3]
        T[:3, 3] = lean @ T[:3, 3] + slow[:3] + rng.normal(0.0, drift.white_m, 3)
    return out


def keyframes(poses: Sequence[Floats]) -> list[Floats]:
    """Return those poses (4, 4) that differ by STEP_M or STEP_RAD from the last one taken, and the last."""
    taken = [poses[0]]
    for T in poses[1:]:
        way = float(np.linalg.norm(T[:3, 3] - taken[-1][:3, 3]))
        turn = float(np.arccos(np.clip(T[:3, 2] @ taken[-1][:3, 2], -1.0, 1.0)))
        if way >= STEP_M or turn >= STEP_RAD:
            taken.append(T)
    return taken if taken[-1] is poses[-1] else [*taken, poses[-1]]


def _shots_path(name: str, cache: Path) -> Path:
    return cache / f"depth-{code_version(_SIMULATOR)}-{name}.npz"


def _trees(text: str) -> tuple[TrueTree, ...]:
    return tuple(TrueTree.model_validate_json(tree) for tree in json.loads(text))


def _cached_shots(name: str, cache: Path) -> _Shots:
    path = _shots_path(name, cache)
    if path.exists():
        with np.load(path) as held:
            return _Shots(held["depth"], held["poses"], _trees(str(held["trees"])))
    shots = _render(name)
    trees_text = json.dumps([tree.model_dump_json() for tree in shots.trees])
    _save(path, small=True, depth=shots.depth, poses=shots.poses, trees=np.array(trees_text))
    return shots


def _render(name: str) -> _Shots:
    from services.simulator.config import SensorConfig
    from services.simulator.render import DEFAULT_INTRINSICS
    from services.simulator.sensor import RgbdSensor

    k = DEFAULT_INTRINSICS
    flight = flown(name)
    sensor = RgbdSensor(SensorConfig(), (k.height, k.width), seed=zlib.crc32(name.encode()))
    return _Shots(depth_images(flight, sensor, k), flight.poses, flight.trees)


@dataclass(frozen=True, slots=True)
class Flight:
    """A scene and the keyframes of the reference's path through it."""

    world: World
    poses_world: tuple[Floats, ...]
    """T_world_camera (4, 4) of each keyframe."""
    poses: Floats
    """(K, 4, 4) T_map_camera, true."""
    trees: tuple[TrueTree, ...]


def flown(name: str) -> Flight:
    """Return a scene's flight.

    Raises:
        InputError: for an unknown scene.
    """
    from services.simulator.catalogue import scene_by_name
    from services.simulator.path import map_frame, reference_path, sample
    from services.simulator.truth import fair_trees, truth_trees
    from services.simulator.world import World

    world = World(scene_by_name(name))
    path = reference_path(world.scene, None, world.clearance)
    steps = [T for _, T in sample(path, _RATE_HZ)]
    T_world_map = map_frame(steps[0])
    poses = keyframes(steps)
    T_map_world = inverse(T_world_map)
    placed = np.stack([T_map_world @ T for T in poses])
    return Flight(world, tuple(poses), placed, truth_trees(world.scene, T_world_map, fair_trees(world, path)))


def depth_images(flight: Flight, sensor: RgbdSensor, k: Intrinsics) -> NDArray[np.uint16]:
    """Return what the sensor measures at each keyframe, (K, H, W) millimetres."""
    from services.simulator.render import Rendering

    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    directions = np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1)
    colour = np.zeros((k.height, k.width, 3), dtype=np.uint8)
    depth = []
    for seq, T in enumerate(flight.poses_world):
        rays = np.empty((*u.shape, 6), dtype=np.float32)
        rays[..., :3], rays[..., 3:] = T[:3, 3], directions @ T[:3, :3].T
        depth.append(sensor.expose(Rendering(colour, flight.world.cast(rays).distance), seq).depth)
    return np.stack(depth)


def _save(path: Path, *, small: bool = False, **arrays: NDArray[np.generic]) -> None:
    """Write the whole file or nothing; ``small`` takes the time to compress."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("wb") as stream:
        (np.savez_compressed if small else np.savez)(stream, allow_pickle=False, **arrays)
    partial.replace(path)


def save_parts(path: Path, parts: _Parts) -> None:
    """Keep what ``fuse`` gave."""
    points, index, origins, rotations, tan_half = parts
    _save(path, points=points, index=index, origins=origins, rotations=rotations, tan_half=np.array(tan_half))


def load_parts(path: Path) -> _Parts:
    """Return what ``save_parts`` kept."""
    with np.load(path) as held:
        tan = held["tan_half"]
        return held["points"], held["index"], held["origins"], held["rotations"], (float(tan[0]), float(tan[1]))
