"""What the real chain would say, without rendering: pose, trees and target of a true camera pose, with its errors.

The errors are those measured on rendered flights (docs/decisions/chain-errors.md) or larger; they are one small model,
so that a benchmark can print them. Frames are dropped and late as the real ones are. Pure but for its own state; all randomness from one generator.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict

from schemas.slam import Pose
from schemas.trees import Target, Tree, TreeList
from services.common.geometry import Matrix, camera_yaw, exp_rotation, rotation_z, to_transform, wrap_angle


class ChainErrors(BaseModel):
    """Errors of the chain: standard deviations, shares and delays."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frame_s: float = 1.0 / 15.0
    delay_min_s: float = 0.08
    delay_max_s: float = 0.15
    drop_share: float = 0.02
    pose_white_m: float = 0.004
    pose_slow_m: float = 0.010
    """Slowly wandering error (time constant ``slow_s``)."""
    pose_white_rad: float = float(np.radians(0.05))
    pose_slow_rad: float = float(np.radians(0.2))
    slow_s: float = 5.0
    loop_m: float = 0.03
    """Correction of the map when the turn closes."""
    loop_rad: float = float(np.radians(0.5))
    tilt_rad: float = float(np.radians(0.8))
    """How far the map leans, about each horizontal axis, for the whole flight."""
    tree_m: float = 0.02
    tree_radius_m: float = 0.006
    range_white_m: float = 0.010
    range_bias_m: float = 0.010
    bearing_white_rad: float = float(np.radians(0.15))
    bearing_bias_rad: float = float(np.radians(0.25))
    """The same for a whole flight: with the white part 0.29 degrees RMS, five rendered flights had 0.27."""
    view_rad: float = float(np.radians(28.0))
    """Half the horizontal field of view in which a trunk is whole."""
    range_max_m: float = 6.0
    miss_share: float = 0.02
    list_s: float = 1.5
    """Delay from what was seen to the list of trees."""
    listed_after_rad: float = float(np.pi)
    """The list is empty before so much of the turn was flown."""


@dataclass(frozen=True, slots=True)
class TrueTrunk:
    """A trunk of the scene in the world: axis at the ground, radius, whether it is a target."""

    x_m: float
    y_m: float
    radius_m: float
    suitable: bool = True


@dataclass(frozen=True, slots=True)
class Delivered:
    """A message and when it reaches its consumers."""

    at_ns: int
    message: Pose | Target | TreeList


class SyntheticChain:
    """Says what slam, detector and refiner would say of the true camera pose."""

    def __init__(
        self, trunks: Sequence[TrueTrunk], T_world_map: Matrix, errors: ChainErrors, rng: np.random.Generator
    ) -> None:
        self.trunks = tuple(trunks)
        self.errors = errors
        self._T_map_world = np.linalg.inv(T_world_map)
        self._rng = rng
        self._slow = np.zeros(4)
        self._map_shift = np.array([*rng.normal(0.0, errors.loop_m, 2), 0.0, rng.normal(0.0, errors.loop_rad)])
        """Error of the map before its loop is closed: x, y, z, yaw."""
        self._list_errors = rng.normal(0.0, 1.0, (len(self.trunks), 3))
        self._range_bias_m = float(rng.normal(0.0, errors.range_bias_m))
        lasting = rng.spawn(1)[0].normal(0.0, 1.0, 3)
        """From a generator of its own: the other errors stay as they were for a seed."""
        self._bearing_bias_rad = errors.bearing_bias_rad * float(lasting[0])
        self._lean = exp_rotation(np.array([*(errors.tilt_rad * lasting[1:]), 0.0]))
        self._seen: set[int] = set()
        self._turned_rad = 0.0
        self._farthest_rad = 0.0
        """How far the turn ever came: what was seen on the way is not forgotten by turning back."""
        self._last_yaw: float | None = None
        self._next_ns = 0
        self._list_ns = 0
        self._queue: deque[Delivered] = deque()
        self._seq = 0
        self._lists = 0
        self.target_id: int | None = None
        self.slam_lost = False
        self.blind = False
        """The camera is silent."""

    @property
    def closed(self) -> bool:
        """Whether the turn has closed its loop."""
        return self._farthest_rad > 2.0 * np.pi

    def observe(self, T_world_camera: Matrix, now_ns: int) -> None:
        """Look at the world, when a frame is due."""
        if now_ns < self._next_ns:
            return
        self._next_ns = max(self._next_ns, now_ns - 1) + round(self.errors.frame_s * 1e9)
        self._seq += 1
        self._wander()
        if self.blind or self._rng.random() < self.errors.drop_share:
            return
        T = self._T_map_world @ T_world_camera
        self._count_turn(camera_yaw(T))
        at_ns = now_ns + round(1e9 * self._rng.uniform(self.errors.delay_min_s, self.errors.delay_max_s))
        believed = self._believed(T)
        self._say(at_ns, self._pose(believed, now_ns))
        self._say(at_ns + 10_000_000, self._target(T, believed, now_ns))
        if now_ns >= self._list_ns:
            self._list_ns = now_ns + 1_000_000_000
            self._lists += 1
            self._say(now_ns + round(1e9 * self.errors.list_s), self._list(now_ns))

    def due(self, now_ns: int) -> list[Pose | Target | TreeList]:
        """Return what has arrived by ``now_ns``."""
        arrived = [d.message for d in self._queue if d.at_ns <= now_ns]
        self._queue = deque(d for d in self._queue if d.at_ns > now_ns)
        return arrived

    def _say(self, at_ns: int, message: Pose | Target | TreeList) -> None:
        self._queue.append(Delivered(at_ns, message))

    def _wander(self) -> None:
        e = self.errors
        keep = float(np.exp(-e.frame_s / e.slow_s))
        sigma = np.array([e.pose_slow_m] * 3 + [e.pose_slow_rad])
        self._slow = keep * self._slow + np.sqrt(1.0 - keep * keep) * sigma * self._rng.normal(size=4)

    def _count_turn(self, yaw_rad: float) -> None:
        if self._last_yaw is not None:
            self._turned_rad += wrap_angle(yaw_rad - self._last_yaw)
            self._farthest_rad = max(self._farthest_rad, self._turned_rad)
        self._last_yaw = yaw_rad

    def _bent(self, p_map: Matrix) -> Matrix:
        """Return a true map point (3,) in the map as it is believed now: leaning, and bent until its loop is closed."""
        p_map = self._lean @ p_map
        if self.closed:
            return p_map
        share = np.clip(self._turned_rad / (2.0 * np.pi), 0.0, 1.0) * self._map_shift
        return rotation_z(float(share[3])) @ p_map + share[:3]

    def _believed(self, T: Matrix) -> Matrix:
        e = self.errors
        out = T.copy()
        out[:3, 3] = self._bent(T[:3, 3]) + self._slow[:3] + self._rng.normal(0.0, e.pose_white_m, 3)
        bend = 0.0 if self.closed else float(np.clip(self._turned_rad / (2.0 * np.pi), 0.0, 1.0) * self._map_shift[3])
        wobble = exp_rotation(self._rng.normal(0.0, e.pose_white_rad, 3))
        out[:3, :3] = wobble @ rotation_z(bend + float(self._slow[3])) @ self._lean @ T[:3, :3]
        return out

    def _pose(self, T: Matrix, stamp_ns: int) -> Pose:
        position, angle = 1e-4, 3e-5
        covariance = np.diag([position] * 3 + [angle] * 3)[np.triu_indices(6)]
        lost = self.slam_lost
        return Pose(
            stamp_ns=stamp_ns, seq=self._seq, map_id="synthetic", status="lost" if lost else "tracking",
            T_map_camera=None if lost else to_transform(T),
            covariance=None if lost else tuple(float(v) for v in covariance), reset_counter=int(self.closed),
            graph_version=0, keyframe_id=None, T_keyframe_camera=None, inliers=0 if lost else 300, up_sigma_rad=0.01,
            processing_ms=30.0,
        )  # fmt: skip

    def _in_view(self, offset_m: Matrix, yaw_rad: float) -> tuple[float, float, bool]:
        distance = float(np.linalg.norm(offset_m))
        bearing = wrap_angle(float(np.arctan2(offset_m[1], offset_m[0])) - yaw_rad)
        return distance, bearing, abs(bearing) < self.errors.view_rad and 0.4 < distance < self.errors.range_max_m

    def _target(self, T: Matrix, believed: Matrix, stamp_ns: int) -> Target:
        e, tree_id = self.errors, self.target_id
        seen = False
        distance = bearing = 0.0
        if tree_id is not None and tree_id < len(self.trunks):
            distance, bearing, seen = self._in_view(self._trunk_map(tree_id)[:2] - T[:2, 3], camera_yaw(T))
            seen = seen and self._rng.random() >= e.miss_share and not self._occluded(tree_id, T)
            distance += self._range_bias_m + float(self._rng.normal(0.0, e.range_white_m))
            noise = self._bearing_bias_rad + float(self._rng.normal(0.0, e.bearing_white_rad))
            bearing = wrap_angle(bearing + noise)
        heading = camera_yaw(believed) + bearing
        place = believed[:2, 3] + distance * np.array([np.cos(heading), np.sin(heading)])
        radius = self.trunks[tree_id].radius_m if seen and tree_id is not None else None
        return Target(
            stamp_ns=stamp_ns, seq=self._seq, map_id="synthetic",
            status="tracking" if seen else "none" if tree_id is None else "lost", tree_id=tree_id, measured=seen,
            bearing_rad=bearing if seen else None, range_m=distance if seen else None, radius_m=radius,
            image_x_px=None, sigma_bearing_rad=None, sigma_range_m=None, sigma_radius_m=None, raw_image_x_px=None,
            raw_range_m=None, raw_radius_m=None,
            position_map_m=(float(place[0]), float(place[1])) if seen else None, covariance_map_m2=None,
        )  # fmt: skip

    def _occluded(self, tree_id: int, T: Matrix) -> bool:
        """Return whether another trunk hides the middle of this one."""
        here = T[:2, 3]
        along = self._trunk_map(tree_id)[:2] - here
        for i, other in enumerate(self.trunks):
            if i == tree_id:
                continue
            offset = self._trunk_map(i)[:2] - here
            share = float(np.clip(offset @ along / (along @ along), 0.0, 1.0))
            if share < 1.0 and float(np.linalg.norm(offset - share * along)) < other.radius_m:
                return True
        return False

    def _trunk_map(self, i: int) -> Matrix:
        t = self.trunks[i]
        return (self._T_map_world @ np.array([t.x_m, t.y_m, 0.0, 1.0]))[:3]

    def _list(self, stamp_ns: int) -> TreeList:
        e = self.errors
        trees = []
        for i in range(len(self.trunks)):
            near = float(np.linalg.norm(self._trunk_map(i)[:2])) <= e.range_max_m
            if near and self._farthest_rad >= e.listed_after_rad:
                trees.append(self._listed(i))
        return TreeList(
            stamp_ns=stamp_ns, map_id="synthetic", version=self._lists, graph_version=int(self.closed),
            trees=tuple(trees),
        )  # fmt: skip

    def _listed(self, i: int) -> Tree:
        e, trunk, p = self.errors, self.trunks[i], self._trunk_map(i)
        place = self._bent(p) + np.array([*(e.tree_m * self._list_errors[i, :2]), 0.0])
        axis = self._lean[:, 2]
        radius = max(trunk.radius_m + e.tree_radius_m * float(self._list_errors[i, 2]), 0.01)
        return Tree(
            id=i, x_m=float(place[0]), y_m=float(place[1]), z_m=float(place[2]),
            axis=(float(axis[0]), float(axis[1]), float(axis[2])), radius_m=radius, radius_height_m=1.3,
            height_seen_m=2.0, sigma_xy_m=e.tree_m, sigma_radius_m=e.tree_radius_m, arc_rad=1.6, confidence=0.9,
            observations=8, suitable=trunk.suitable,
        )  # fmt: skip
