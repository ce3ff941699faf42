"""Writes a simulated flight as a TUM RGB-D folder, with the truth beside it. An offline tool."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

import numpy as np

from services.common.geometry import inverse, quaternion_from_rotation
from services.simulator.camera import SimulatedCamera
from services.simulator.config import PathConfig, SensorConfig
from services.simulator.path import ReferencePath, map_frame, reference_path, sample, stamp_of
from services.simulator.scene import Floats, Scene
from services.simulator.sensor import Accelerometer
from services.simulator.truth import fair_trees, truth_trees
from services.simulator.world import World

ACCEL_RATE_HZ = 100.0

Progress = Callable[[int, int], None]


def write_sequence(
    scene: Scene,
    out_dir: Path,
    rate_hz: float = 15.0,
    reduced: bool = False,
    frames: int | None = None,
    seed: int = 0,
    path_config: PathConfig | None = None,
    sensor_config: SensorConfig | None = None,
    progress: Progress | None = None,
) -> int:
    """Fly the reference's path through a scene and write what the camera saw; returns the number of frames.

    Writes rgb/ (JPEG), depth/ (PNG, millimetres), rgb.txt, depth.txt, associations.txt, accelerometer.txt,
    camera.json, groundtruth.txt (``T_map_camera``) and truth.json (the trees in ``map``). Stamps are seconds.
    ``seed`` draws the sensor's noise. The same arguments write the same bytes.
    """
    world = World(scene)
    path = reference_path(scene, path_config, world.clearance)
    steps = sample(path, rate_hz, frames)
    T_world_map = map_frame(steps[0][1])
    camera = SimulatedCamera(world, sensor_config or SensorConfig(), reduced, seed)
    for name in ("rgb", "depth"):
        (out_dir / name).mkdir(parents=True, exist_ok=True)
    _write_images(out_dir, camera, steps, progress)
    _write_lists(out_dir, steps, T_world_map)
    with (out_dir / "accelerometer.txt").open("w", encoding="utf-8") as file:
        _write_accelerometer(file, path, steps[-1][0], Accelerometer(sensor_config or SensorConfig(), seed))
    (out_dir / "camera.json").write_text(camera.intrinsics.model_dump_json() + "\n", encoding="utf-8")
    trees = truth_trees(scene, T_world_map, fair_trees(world, path))
    target = None if path.target is None else scene.trees.index(path.target)
    truth = {"scene": scene.name, "frame": "map", "target": target, "trees": [tree.model_dump() for tree in trees]}
    (out_dir / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return len(steps)


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000 // 1000:06d}"


def _write_images(
    out_dir: Path, camera: SimulatedCamera, steps: list[tuple[int, Floats]], progress: Progress | None
) -> None:
    import cv2

    for index, (stamp_ns, T_world_camera) in enumerate(steps):
        images = camera.look(T_world_camera, index)
        name = _seconds(stamp_ns)
        cv2.imwrite(str(out_dir / "rgb" / f"{name}.jpg"), images.colour, [cv2.IMWRITE_JPEG_QUALITY, 95])
        cv2.imwrite(str(out_dir / "depth" / f"{name}.png"), images.depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if progress is not None:
            progress(index + 1, len(steps))


def _write_lists(out_dir: Path, steps: list[tuple[int, Floats]], T_world_map: Floats) -> None:
    names = [_seconds(stamp_ns) for stamp_ns, _ in steps]
    texts = {
        "rgb.txt": [f"{n} rgb/{n}.jpg" for n in names],
        "depth.txt": [f"{n} depth/{n}.png" for n in names],
        "associations.txt": [f"{n} rgb/{n}.jpg {n} depth/{n}.png" for n in names],
    }
    T_map_world = inverse(T_world_map)
    truth = []
    for name, (_, T_world_camera) in zip(names, steps, strict=True):
        T = T_map_world @ T_world_camera
        values = (*T[:3, 3], *quaternion_from_rotation(T[:3, :3]))
        truth.append(" ".join([name, *(f"{value:.6f}" for value in values)]))
    texts["groundtruth.txt"] = ["# timestamp tx ty tz qx qy qz qw: camera in map", *truth]
    for file, lines in texts.items():
        (out_dir / file).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_accelerometer(file: TextIO, path: ReferencePath, end_ns: int, sensor: Accelerometer) -> None:
    """Specific force in the axes of TUM's files: x left, y up, z forward, the camera turned about its optical axis.

    (Found by fitting TUM's accelerometer.txt to gravity in its groundtruth.txt, on two recordings.)
    """
    file.write("# specific force, m/s^2, axes left, up, forward of the camera (as in the TUM recordings)\n")
    file.write("# timestamp ax ay az\n")
    index = 0
    while (stamp_ns := stamp_of(index, ACCEL_RATE_HZ)) <= end_ns:
        t_s = index / ACCEL_RATE_HZ
        x, y, z = sensor.measure(path.at(t_s)[:3, :3], path.acceleration(t_s))
        file.write(f"{_seconds(stamp_ns)} {-x:.6f} {-y:.6f} {np.float64(z):.6f}\n")
        index += 1
