"""Simulated depth images with truth for ``bench depth``.

Views all round, a camera at rest, one that turns, a bent lens, a depth camera beside the colour camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import level_camera

if TYPE_CHECKING:
    from services.simulator.render import Renderer
    from services.simulator.scene import Scene
    from services.simulator.sensor import RgbdSensor

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]
Floats = NDArray[np.float64]

KINDS = ("multi", "undergrowth", "slope")
REST_SHOTS, TURN_SHOTS = 10, 8
_TURN_RAD = np.radians(30.0) / 15.0
"""Between two frames of the reference's turn: 30 degrees a second at 15 Hz."""
_BASE_M = 0.058
"""Between the R200's depth and colour cameras."""
_BENT = {"k1": 0.2624, "k2": -0.9531, "p1": -0.0054, "p2": 0.0026, "k3": 1.1633}
"""The lens of TUM's freiburg1 recordings."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A true and a sensed depth image (H, W) in metres, and the grey image."""

    true: Image
    sensed: Image
    grey: Grey


@dataclass(frozen=True, slots=True)
class BentShot:
    """A depth image through a bent lens, with the true points."""

    camera: Intrinsics
    sensed: Image
    points_m: Floats
    """(H, W, 3) of each pixel's true ray and depth."""


@dataclass(frozen=True, slots=True)
class PairShot:
    """A depth image of a camera beside the colour camera, and the true depth in the colour camera."""

    camera: Intrinsics
    T_colour_depth: Floats
    sensed: Image
    true: Image


def around(seed: int, count: int) -> Iterator[Shot]:
    """Yield views all round fresh scenes."""
    for k in range(count):
        scene = f"random-{KINDS[k % len(KINDS)]}-{51_000 + seed}"
        yield from _look(scene, [level_camera((0.0, 0.0, 1.5), 2.0 * np.pi * k / count)], k)


def at_rest(seed: int) -> list[Shot]:
    """Return one view again and again."""
    return list(_look(f"random-multi-{52_000 + seed}", [level_camera((0.0, 0.0, 1.5), 0.0)] * REST_SHOTS, 0))


def turning(seed: int) -> list[Shot]:
    """Return the views of a camera that turns on the spot."""
    poses = [level_camera((0.0, 0.0, 1.5), _TURN_RAD * k) for k in range(TURN_SHOTS)]
    return list(_look(f"random-multi-{52_000 + seed}", poses, 0))


def bent(shot: Shot) -> BentShot:
    """Return a shot as a camera with a bent lens takes it: nearest pixel, no depth is mixed."""
    import cv2

    from services.simulator.render import DEFAULT_INTRINSICS

    camera = DEFAULT_INTRINSICS.model_copy(update=_BENT)
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    lens = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-12)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    rays = np.asarray(cv2.undistortPoints(pixels, K, lens, None, None, None, criteria)).reshape(*u.shape, 2)
    x, y = rays[..., 0], rays[..., 1]
    at_u = (camera.fx * x + camera.cx).astype(np.float32)
    at_v = (camera.fy * y + camera.cy).astype(np.float32)
    sensed, true = (
        np.asarray(cv2.remap(image, at_u, at_v, cv2.INTER_NEAREST), dtype=np.float32)
        for image in (shot.sensed, shot.true)
    )
    with np.errstate(invalid="ignore"):  # the sky is infinitely far
        points = np.stack([x * true, y * true, true], axis=-1).astype(np.float64)
    return BentShot(camera, np.where(true > 0, sensed, np.float32(0.0)), points)


def beside(seed: int) -> PairShot:
    """Return a depth image taken 5.8 cm beside the colour camera."""
    from services.simulator.render import DEFAULT_INTRINSICS

    pose = level_camera((0.0, 0.0, 1.5), 0.0)
    depth_pose = pose.copy()
    depth_pose[:3, 3] += pose[:3, 0] * _BASE_M
    colour, depth = _look(f"random-multi-{52_000 + seed}", [pose, depth_pose], 0)
    T = np.eye(4)
    T[0, 3] = _BASE_M
    return PairShot(DEFAULT_INTRINSICS, T, depth.sensed, colour.true)


def _look(scene_name: str, poses: Sequence[Floats], first: int) -> Iterator[Shot]:
    import cv2

    scene, renderer, sensor = _stage(scene_name)
    before, rendering = None, None
    for k, T in enumerate(poses):
        if rendering is None or before is not T:
            lifted = T.copy()
            lifted[2, 3] += scene.ground.at(0.0, 0.0)
            rendering, before = renderer.render(lifted), T
        images = sensor.expose(rendering, first + k)
        grey = np.asarray(cv2.cvtColor(images.colour, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        yield Shot(rendering.depth_m.copy(), images.depth.astype(np.float32) / np.float32(1000.0), grey)


@lru_cache(maxsize=len(KINDS) + 1)
def _stage(scene_name: str) -> tuple[Scene, Renderer, RgbdSensor]:
    """Return a scene with what renders it: making its world costs as much as seven pictures of it."""
    from services.simulator.catalogue import scene_by_name
    from services.simulator.config import SensorConfig
    from services.simulator.render import DEFAULT_INTRINSICS, Renderer
    from services.simulator.sensor import RgbdSensor
    from services.simulator.world import World

    scene = scene_by_name(scene_name)
    shape = (DEFAULT_INTRINSICS.height, DEFAULT_INTRINSICS.width)
    return scene, Renderer(World(scene), DEFAULT_INTRINSICS), RgbdSensor(SensorConfig(), shape)
