"""A long walk through a simulated forest: a closed circuit and a piece of it again, rendered at half size to one file.

The camera looks ahead along the path. The file holds each frame's grey image (JPEG) and depth (zstd) at half size and
its true pose; reading scales them up as the simulated camera does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import R_BODY_CAMERA, exp_rotation, inverse, pose, rotation_z
from services.simulator.config import SensorConfig
from services.simulator.path import map_frame
from services.simulator.scene import Backdrop, Ground, Scene, SceneTree, Wave

F64 = NDArray[np.float64]

CIRCUIT_M, LENGTH_M = 180.0, 200.0
FRAMES = 6000
"""Of the whole walk: 1 m/s at 30 Hz. A shorter one is its beginning."""
HEIGHT_M = 1.5
_RADIUS_M = CIRCUIT_M / (2.0 * math.pi)
_HALF_WIDTH_M = 9.0
_FREE_M = 1.0
_TREES = 260
_HEAD_BYTES = 8 + 128
"""Of a frame in the file: the sizes of its two images, its pose."""


@dataclass(frozen=True, slots=True)
class WalkFrame:
    """One frame at full size."""

    index: int
    grey: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_map_camera: F64
    """The truth."""


def walk_scene(seed: int) -> Scene:
    """Return a forest on both sides of a circular path."""
    rng = np.random.default_rng([seed, 909])
    waves = []
    for _ in range(6):
        length, heading = rng.uniform(9.0, 30.0), rng.uniform(0.0, 2.0 * math.pi)
        k = 2.0 * math.pi / length
        waves.append(Wave(0.012 * length, k * math.cos(heading), k * math.sin(heading), float(rng.uniform(0, 6.28))))
    ground = Ground(waves=tuple(waves))
    trees: list[SceneTree] = []
    while len(trees) < _TREES:
        angle, off = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(_FREE_M, _HALF_WIDTH_M) * rng.choice([-1.0, 1.0])
        r = _RADIUS_M + off
        x, y = float(r * math.cos(angle) - _RADIUS_M), float(r * math.sin(angle))
        if any(math.hypot(x - t.x_m, y - t.y_m) < 1.1 for t in trees):
            continue
        lean, turn, radius = rng.uniform(0.0, 0.08), rng.uniform(0.0, 6.28), float(rng.uniform(0.05, 0.25))
        axis = (math.sin(lean) * math.cos(turn), math.sin(lean) * math.sin(turn), math.cos(lean))
        trees.append(SceneTree(x, y, ground.at(x, y), axis, radius, int(rng.integers(2**31)), taper=0.05 * radius))
    return Scene(f"walk-{seed}", seed, tuple(trees), ground=ground, backdrop=Backdrop(radius_m=75.0, height_m=14.0))


def walk_pose(scene: Scene, way_m: float) -> F64:
    """Return ``T_world_camera`` (4, 4) after so many metres: ahead along the circle, with the sway of a hover."""
    angle = way_m / _RADIUS_M
    x, y = _RADIUS_M * (math.cos(angle) - 1.0), _RADIUS_M * math.sin(angle)
    t = 2.0 * way_m
    look = angle + 0.5 * math.pi + 0.25 * math.sin(way_m / 4.0)
    sway = exp_rotation([0.02 * math.sin(1.9 * t), 0.02 * math.sin(2.9 * t + 1.0), 0.0])
    z = scene.ground.at(x, y) + HEIGHT_M + 0.03 * math.sin(2.1 * t)
    return pose(rotation_z(look) @ sway @ R_BODY_CAMERA, [x, y, z])


def render_walk(path: Path, seed: int, frames: int, progress: Callable[[int], None] | None = None) -> None:
    """Render the walk into ``path`` (about 60 KB a frame); what is there already of the same walk is gone on with."""
    import cv2
    from zstandard import ZstdCompressor

    from services.simulator.render import DEFAULT_INTRINSICS, Renderer, halved
    from services.simulator.sensor import RgbdSensor
    from services.simulator.world import World

    done = trim_walk(path)
    if done >= frames:
        return
    scene = walk_scene(seed)
    small = halved(DEFAULT_INTRINSICS)
    renderer = Renderer(World(scene), small)
    sensor = RgbdSensor(SensorConfig(), (small.height, small.width), 1.0, seed)
    squeeze = ZstdCompressor(level=1)
    T_map_world = inverse(map_frame(walk_pose(scene, 0.0)))
    with path.open("ab") as file:
        for index in range(done, frames):
            T = walk_pose(scene, LENGTH_M * index / FRAMES)
            images = sensor.expose(renderer.render(T), index)
            grey = cv2.cvtColor(images.colour, cv2.COLOR_BGR2GRAY)
            jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            depth = squeeze.compress(images.depth.tobytes())
            sizes = np.array([len(jpeg), len(depth)], np.uint32).tobytes()
            file.write(sizes + (T_map_world @ T).tobytes() + jpeg + depth)
            if progress is not None:
                progress(index + 1)


def trim_walk(path: Path) -> int:
    """Cut off a half frame that an interrupted rendering left at the end; return how many whole ones there are."""
    if not path.exists():
        return 0
    size, at, count = path.stat().st_size, 0, 0
    with path.open("r+b") as file:
        while len(head := file.read(_HEAD_BYTES)) == _HEAD_BYTES:
            end = at + _HEAD_BYTES + int(np.frombuffer(head[:8], np.uint32).sum())
            if end > size:
                break
            at, count = end, count + 1
            file.seek(at)
        file.truncate(at)
    return count


def read_walk(path: Path) -> Iterator[WalkFrame]:
    """Yield the frames of a rendered walk."""
    import cv2
    from zstandard import ZstdDecompressor

    expand = ZstdDecompressor()
    index = 0
    with path.open("rb") as file:
        while head := file.read(_HEAD_BYTES):
            n_jpeg, n_depth = np.frombuffer(head[:8], np.uint32)
            small = np.asarray(cv2.imdecode(np.frombuffer(file.read(int(n_jpeg)), np.uint8), cv2.IMREAD_GRAYSCALE))
            raw = np.frombuffer(expand.decompress(file.read(int(n_depth))), np.uint16).reshape(small.shape)
            grey = cv2.resize(small, (2 * small.shape[1], 2 * small.shape[0]), interpolation=cv2.INTER_LINEAR)
            depth_m = np.repeat(np.repeat(raw, 2, axis=0), 2, axis=1).astype(np.float32) / np.float32(1000.0)
            yield WalkFrame(index, np.asarray(grey, np.uint8), depth_m, np.frombuffer(head[8:]).reshape(4, 4).copy())
            index += 1
