"""Flown ways through a rendered forest, seen by two cameras and located by the real slam, with faults of the first camera.

Each camera's frames are rendered once, at half size, and go to one slam for every fault. What slam told is kept in one file
for each scene, so that fusion can be run over it in a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import Matrix
from services.common.mount import Mount
from services.evaluate.fusion_flight import FRAME_HZ, FlownWay
from services.evaluate.slam_walk import CIRCUIT_M, HEIGHT_M, walk_scene
from services.fusion.values import Located
from services.simulator.scene import Scene

SECONDS = 32.0
SPEED_M_S = 0.5
BLACKOUTS_S = ((7.0, 7.5), (11.0, 12.0), (16.0, 18.0), (23.0, 27.0))
LOW_TEXTURE_S = ((8.0, 10.0), (16.0, 20.0), (25.0, 26.0))
FIRST: Matrix = Mount.level((0.08, 0.0, 0.0)).T_body_camera
SECOND: Matrix = Mount.level((0.0, 0.0, -0.05), math.pi / 2).T_body_camera
"""Straight down."""
_RADIUS_M = CIRCUIT_M / (2.0 * math.pi)

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Spoil = Callable[[U8, F32, np.random.Generator], tuple[U8, F32]]


def circle(scene: Scene) -> Callable[[float], tuple[Matrix, float]]:
    """Return the way: ahead along the scene's free circle, looking a little to both sides."""

    def way(t_s: float) -> tuple[Matrix, float]:
        way_m = SPEED_M_S * t_s
        angle = way_m / _RADIUS_M
        x, y = _RADIUS_M * (math.cos(angle) - 1.0), _RADIUS_M * math.sin(angle)
        yaw = angle + 0.5 * math.pi + 0.25 * math.sin(way_m / 4.0)
        return np.array([x, y, scene.ground.at(x, y) + HEIGHT_M]), yaw

    return way


def covered(grey: U8, depth_m: F32, rng: np.random.Generator) -> tuple[U8, F32]:
    """Nothing is seen: the sensor's noise in the dark, no depth."""
    return rng.integers(0, 4, grey.shape, dtype=np.uint8), np.zeros_like(depth_m)


def bare(grey: U8, depth_m: F32, rng: np.random.Generator) -> tuple[U8, F32]:
    """Fog: blurred by 4 pixels, a tenth of the contrast, the sensor's noise stays, depth ends at 2 m."""
    import cv2

    soft = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 4.0)
    flat = 150.0 + 0.1 * (soft - 128.0) + rng.normal(0.0, 1.5, soft.shape)
    return np.clip(flat, 0, 255).astype(np.uint8), np.where(depth_m < 2.0, depth_m, 0.0).astype(np.float32)


FAULTS: dict[str, tuple[tuple[tuple[float, float], ...], Spoil]] = {
    "blackout": (BLACKOUTS_S, covered),
    "low texture": (LOW_TEXTURE_S, bare),
}


@dataclass(frozen=True, slots=True)
class Seen:
    """What slam told of one camera's frames."""

    T_map_camera: Matrix
    """(N, 4, 4), NaN where it had none."""
    covariance: Matrix
    epoch: NDArray[np.int64]
    """(N, 2): number of the map, reset counter."""

    def located(self, flown: FlownWay) -> list[Located | None]:
        """Return it frame by frame."""
        return [
            None if math.isnan(T[0, 0]) else Located(frame.stamp_ns, T, C, (f"map-{e[0]}", int(e[1])))
            for frame, T, C, e in zip(flown.frames, self.T_map_camera, self.covariance, self.epoch, strict=True)
        ]


class _Slam:
    """One slam, its fault, and what it told."""

    def __init__(self, intrinsics: object, fault: str | None, seed: int) -> None:
        from schemas.camera import Intrinsics
        from services.slam.config import SlamConfig
        from services.slam.slam import Slam

        assert isinstance(intrinsics, Intrinsics)
        self._slam = Slam(intrinsics, SlamConfig())
        self._fault = fault
        self._rng = np.random.default_rng([seed, 707])
        self._rows: list[tuple[Matrix, Matrix, tuple[int, int]]] = []

    def take(self, index: int, stamp_ns: int, grey: U8, depth_m: F32, up_camera: Matrix) -> None:
        """Locate one frame, spoilt where the fault says so."""
        if self._fault is not None:
            times, spoil = FAULTS[self._fault]
            if any(a <= index / FRAME_HZ < b for a, b in times):
                grey, depth_m = spoil(grey, depth_m, self._rng)
        result = self._slam.track(stamp_ns, grey, depth_m, None, up_camera)
        nothing = result.T_map_camera is None or result.status != "tracking" or result.covariance is None
        T = np.full((4, 4), np.nan) if nothing else result.T_map_camera
        C = np.full((6, 6), np.nan) if nothing else result.covariance
        assert T is not None
        assert C is not None
        self._rows.append((T, C, (0, result.reset_counter)))

    def seen(self) -> Seen:
        """Return what was told so far."""
        T, C, epoch = zip(*self._rows, strict=True)
        return Seen(np.array(T), np.array(C), np.array(epoch, dtype=np.int64))


def see(flown: FlownWay, seed: int, kept: Path, progress: Callable[[str], None]) -> dict[str, Seen]:
    """Return what slam tells of a flight: by fault for the first camera, ``second`` for the other.

    Each camera's part is kept in a file of its own below ``kept``, so that an interrupted call loses one at most.
    """
    kept.mkdir(parents=True, exist_ok=True)
    out: dict[str, Seen] = {}
    cameras: tuple[tuple[str, Matrix, list[str | None]], ...] = (
        ("first", FIRST, list(FAULTS)),
        ("second", SECOND, [None]),
    )
    for name, mount, faults in cameras:
        path = kept / f"{name}.npz"
        if not path.exists():
            _keep(path, _rendered(flown, seed, mount, faults, partial(_told, progress, name)))
        with np.load(path) as data:
            keys = [fault or "second" for fault in faults]
            out |= {n: Seen(data[f"{n} T"], data[f"{n} C"], data[f"{n} epoch"]) for n in keys}
    return out


def _told(progress: Callable[[str], None], camera: str, text: str) -> None:
    progress(f"{camera} camera: {text}")


def _keep(path: Path, told: dict[str, Seen]) -> None:
    arrays: dict[str, NDArray[Any]] = {}
    for name, seen in told.items():
        arrays |= {f"{name} T": seen.T_map_camera, f"{name} C": seen.covariance, f"{name} epoch": seen.epoch}
    half = path.with_suffix(".half.npz")
    np.savez_compressed(half, allow_pickle=False, **arrays)
    half.rename(path)


def _rendered(
    flown: FlownWay, seed: int, T_body_camera: Matrix, faults: Sequence[str | None], progress: Callable[[str], None]
) -> dict[str, Seen]:
    import cv2

    from services.simulator.camera import SimulatedCamera
    from services.simulator.config import SensorConfig
    from services.simulator.world import World

    camera = SimulatedCamera(World(walk_scene(seed)), SensorConfig(), reduced=True, seed=seed)
    slams = {fault or "second": _Slam(camera.intrinsics, fault, seed) for fault in faults}
    for index, frame in enumerate(flown.frames):
        T = frame.T_world_body @ T_body_camera
        images = camera.look(T, index)
        grey = np.asarray(cv2.cvtColor(images.colour, cv2.COLOR_BGR2GRAY), np.uint8)
        depth_m = images.depth.astype(np.float32) / np.float32(camera.intrinsics.depth_scale)
        for slam in slams.values():
            slam.take(index, frame.stamp_ns, grey, depth_m, T[2, :3])
        if index % 60 == 0:
            progress(f"frame {index} of {len(flown.frames)}")
    return {name: slam.seen() for name, slam in slams.items()}
