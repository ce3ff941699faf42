"""The reference's path: rest, rise, turn on the spot, face the nearest suitable tree, approach, hold."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from services.common.geometry import R_BODY_CAMERA, exp_rotation, pose, rotation_z, wrap_angle
from services.simulator.config import PathConfig
from services.simulator.scene import Floats, Scene, SceneTree

_RAMP_SHARE = 0.2
"""Share of a movement's time for speeding up, and as much for slowing down."""
_SWAY_RAD_S = ((2.1, 0.0), (3.3, 1.0), (2.7, 2.0))
"""Angular frequency and phase of the sway in x, y, z."""
_TILT_RAD_S = ((1.9, 0.5), (2.9, 1.7))
BODY_RADIUS_M = 0.35
"""The way to a tree must be free by this much."""
START_STAMP_NS = 1_000_000_000

Clearance = Callable[[Floats], float]


@dataclass(frozen=True, slots=True)
class _Leg:
    """A straight movement from one position and yaw to another."""

    duration_s: float
    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    start_yaw_rad: float
    end_yaw_rad: float

    def at(self, t_s: float) -> tuple[Floats, float]:
        """Return position (3,) and yaw at a time since the leg's beginning."""
        share = eased(t_s / self.duration_s) if self.duration_s > 0.0 else 1.0
        start, end = np.array(self.start_m), np.array(self.end_m)
        return start + share * (end - start), self.start_yaw_rad + share * (self.end_yaw_rad - self.start_yaw_rad)


def eased(x: float) -> float:
    """Return the share of way done at share ``x`` of the time: smooth in velocity and acceleration.

    The speed rises as ``(1 - cos) / 2`` over the ramp, stays, and falls the same way.
    """
    r = _RAMP_SHARE
    x = min(1.0, max(0.0, x))

    def ramp(y: float) -> float:
        return 0.5 * (y - r / math.pi * math.sin(math.pi * y / r))

    if x < r:
        way = ramp(x)
    elif x <= 1.0 - r:
        way = 0.5 * r + (x - r)
    else:
        way = (1.0 - r) - ramp(1.0 - x)
    return way / (1.0 - r)


@dataclass(frozen=True, slots=True)
class ReferencePath:
    """The camera's pose as a function of time."""

    legs: tuple[_Leg, ...]
    config: PathConfig
    target: SceneTree | None
    """The tree approached; None when no suitable tree can be reached."""

    @property
    def duration_s(self) -> float:
        """Return the time from rest to the end of the hold."""
        return sum(leg.duration_s for leg in self.legs)

    def at(self, t_s: float) -> Floats:
        """Return ``T_world_camera`` (4, 4) at a time; before the beginning and after the end it rests."""
        t_s = min(max(t_s, 0.0), self.duration_s)
        left = t_s
        for leg in self.legs:
            if left <= leg.duration_s:
                break
            left -= leg.duration_s
        position, yaw = leg.at(left)
        sway, tilt = self._sway(t_s)
        return pose(rotation_z(yaw) @ exp_rotation([tilt[0], tilt[1], 0.0]) @ R_BODY_CAMERA, position + sway)

    def _sway(self, t_s: float) -> tuple[Floats, Floats]:
        """Small movements that a hovering aircraft makes; none on the ground."""
        flying = t_s - self.config.rest_s
        strength = eased(flying / 2.5)
        sway = [math.sin(w * flying + p) - math.sin(p) * math.exp(-flying) for w, p in _SWAY_RAD_S]
        tilt = [math.sin(w * flying + p) for w, p in _TILT_RAD_S]
        return strength * self.config.sway_m * np.array(sway), strength * self.config.tilt_rad * np.array(tilt)

    def acceleration(self, t_s: float) -> Floats:
        """Return the camera's acceleration in the world, m/s^2 (3,), by central differences."""
        h = 0.02
        before, now, after = (self.at(t_s + dt)[:3, 3] for dt in (-h, 0.0, h))
        return np.asarray((before - 2.0 * now + after) / h**2)


def reference_path(scene: Scene, config: PathConfig | None = None, clearance: Clearance | None = None) -> ReferencePath:
    """Return the scripted path through a scene.

    ``clearance(point) -> metres`` (``World.clearance``) makes it pass over trees whose way is blocked; without it
    the nearest suitable tree is taken.
    """
    config = config or PathConfig()
    yaw = scene.start_yaw_rad
    ground = scene.ground.at(0.0, 0.0)
    low, high = (0.0, 0.0, ground + config.start_height_m), (0.0, 0.0, ground + config.height_m)
    legs = [
        _Leg(config.rest_s, low, low, yaw, yaw),
        _Leg(_duration(config.height_m - config.start_height_m, config.speed_m_s), low, high, yaw, yaw),
        _Leg(0.5, high, high, yaw, yaw),
        _Leg(_duration(2.0 * math.pi, config.turn_rate_rad_s), high, high, yaw, yaw + 2.0 * math.pi),
        _Leg(0.5, high, high, yaw, yaw),
    ]
    target = _choose(scene, np.array(high), config, clearance)
    if target is not None:
        dock, facing = _dock(scene, target, np.array(high), config)
        turn = wrap_angle(facing - yaw)
        end = (float(dock[0]), float(dock[1]), float(dock[2]))
        way = float(np.linalg.norm(dock - np.array(high)))
        legs += [
            _Leg(_duration(abs(turn), config.turn_rate_rad_s), high, high, yaw, yaw + turn),
            _Leg(_duration(way, config.speed_m_s), high, end, yaw + turn, yaw + turn),
            _Leg(config.hold_s, end, end, yaw + turn, yaw + turn),
        ]
    return ReferencePath(tuple(legs), config, target)


def _duration(way: float, speed: float) -> float:
    """Time for a way at a top speed (``eased`` spends two ramps at half speed on average)."""
    return max(way / (speed * (1.0 - _RAMP_SHARE)), 0.2)


def _dock(scene: Scene, tree: SceneTree, here: Floats, config: PathConfig) -> tuple[Floats, float]:
    """Return the docked position and the heading to the trunk's axis at the camera's height there."""
    dock = here
    for _ in range(4):  # the axis leans and the ground rises: a few rounds settle both
        axis_point = tree.centre_at(max(0.3, float(dock[2]) - tree.z_m))[:2]
        away = here[:2] - axis_point
        place = axis_point + config.dock_distance_m * away / np.linalg.norm(away)
        dock = np.append(place, scene.ground.at(*place) + config.height_m)
    toward = axis_point - here[:2]
    return dock, math.atan2(float(toward[1]), float(toward[0]))


def _choose(scene: Scene, here: Floats, config: PathConfig, clearance: Clearance | None) -> SceneTree | None:
    """Return the nearest suitable tree that can be reached on a free straight way."""
    for tree in sorted(scene.suitable_trees, key=lambda tree: math.hypot(tree.x_m, tree.y_m)):
        dock, _ = _dock(scene, tree, here, config)
        way = np.linspace(here, dock, 12)
        if clearance is None or all(clearance(point) > BODY_RADIUS_M for point in way):
            return tree
    return None


def sample(path: ReferencePath, rate_hz: float, frames: int | None = None) -> list[tuple[int, Floats]]:
    """Return ``(stamp_ns, T_world_camera)`` at a rate, the first ``frames`` or all; stamps are whole microseconds."""
    count = int(path.duration_s * rate_hz) + 1
    count = count if frames is None else min(frames, count)
    return [(stamp_of(i, rate_hz), path.at(i / rate_hz)) for i in range(count)]


def stamp_of(index: int, rate_hz: float) -> int:
    """Return the stamp of frame ``index``."""
    return START_STAMP_NS + round(index * 1e6 / rate_hz) * 1000


def map_frame(T_world_camera: Floats) -> Floats:
    """Return ``T_world_map``: origin at the first camera, x its heading on the horizontal, z up."""
    forward = T_world_camera[:3, 2]
    return pose(rotation_z(math.atan2(forward[1], forward[0])), T_world_camera[:3, 3])
