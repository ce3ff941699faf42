"""RGB-D SLAM: one call per frame. Reads as the method: extract, predict, follow, join the map, perhaps a keyframe.

After Mur-Artal and Tardos, "ORB-SLAM2" (2017), built anew for turns on the spot: points straight from depth up to the
sensor's range, temporary points of the last frame, keyframes at once when close points run out.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from schemas.slam import GraphReason, SlamStatus
from services.common.geometry import inverse, orthonormal, pose
from services.slam import gravity, movers, vocabulary
from services.slam.atlas import Atlas
from services.slam.camera import camera_model
from services.slam.config import SlamConfig
from services.slam.features import Extractor, Features
from services.slam.ground import ground_up
from services.slam.keyframing import KeyframeRule, Rest
from services.slam.lag import Lag
from services.slam.links import shared_counts
from services.slam.loops import Loops
from services.slam.mapping import Mapping
from services.slam.motion import STILL, Motion, Velocity
from services.slam.places import Places
from services.slam.relocation import Relocation, step_between
from services.slam.results import GraphUpdate, NewKeyframe, TrackResult, map_covariance
from services.slam.shutter import Shutter
from services.slam.tracking import Tracked, Tracking, moved
from services.slam.trail import Trail
from services.slam.verify import Verifier
from services.slam.worker import Crew, Inline

F64 = NDArray[np.float64]

_MIN_START_POINTS = 100
"""Features with depth that makes map points that a first keyframe needs."""
_JUMP_M = 0.01
_JUMP_RAD = 0.005
"""A loop that moves the camera by more is told as a jump."""


class Slam:
    """Tracks one camera and keeps one map; knows no clock and no bus; deterministic with an ``Inline`` crew.

    ``crew`` does the mapping; ``keep_trail`` remembers the way: not for a service that runs without end.
    """

    def __init__(
        self, intrinsics: Intrinsics, config: SlamConfig, map_id: str = "map-1", crew: Crew | None = None,
        keep_trail: bool = True,
    ) -> None:  # fmt: skip
        self.crew: Crew = Inline() if crew is None else crew
        self.intrinsics = intrinsics
        self.config = config
        self.map_id = map_id
        camera = camera_model(intrinsics, config)
        self.camera = camera
        self._extractor = Extractor(intrinsics, config)
        cells = camera.cols * int(np.ceil(intrinsics.height / 20.0))
        self.atlas = Atlas(config.features, cells, config.scale, config.levels)
        self.mapping = Mapping(self.atlas, camera, config, self.crew, self._extractor.depth_noise)
        self.tracking = Tracking(self.atlas, camera, config, self.mapping.far)
        self.loops = Loops(self.mapping, self.tracking, Places(vocabulary.load()), config)
        self.reset_counter = 0
        self.graph_version = 0
        self._upright = gravity.Upright()
        self._felt: tuple[int, F64 | None, F64 | None] | None = None
        """Stamp, specific force and the autopilot's up of the last frame, when it was located."""
        self._last: Tracked | None = None
        self._was_lost = False
        """No pose was found for the frame before."""
        self._motion = Motion()
        self.shutter = Shutter(self.atlas, camera)
        self._lag = Lag(intrinsics, camera, config, self._extractor.depth_noise)
        self._verifier = Verifier(intrinsics, camera)
        self._relocation = Relocation(self.loops, self._verifier)
        self._reference = -1
        self._anchor: F64 = np.eye(4)
        """T_keyframe_camera of the last tracked frame."""
        self._rule, self._rest = KeyframeRule(config), Rest()
        self._trail = Trail() if keep_trail else None
        self._revision = 0
        """Of the mapping's corrections, the last one taken over; and of its loops."""
        self._closed = 0
        self.settled_ms: deque[float] = deque(maxlen=1000)
        """How long mapping took over each keyframe."""
        self.on_made: Callable[[int], None] | None = None
        """Called by the crew with the slot of each new keyframe, and after its mapping: for who keeps the map."""
        self.on_settled: Callable[[], None] | None = None
        self._era0 = 0
        self._taken_up = False
        """The map is from an earlier life, and no frame has been located in it yet."""

    def track(
        self,
        stamp_ns: int,
        grey: NDArray[np.uint8],
        depth_m: NDArray[np.float32],
        accel_camera: F64 | None = None,
        attitude_up_camera: F64 | None = None,
        depth_after_s: float = 0.0,
    ) -> TrackResult:
        """Locate one frame: ``grey`` (H, W), ``depth_m`` (H, W) metres, 0 = none.

        ``accel_camera`` (3,) m/s^2 in the camera's frame (at rest up times 9.81), ``attitude_up_camera`` (3,) up in the
        camera's frame as the autopilot tells it, ``depth_after_s`` the depth image's stamp less ``stamp_ns``.
        """
        accel_camera, attitude_up_camera = gravity.direction(accel_camera), gravity.direction(attitude_up_camera)
        features = self._extractor.extract(grey, depth_m)
        self._lag.begin(depth_m, depth_after_s)
        self.crew.keep_up()
        with self.crew.frame():
            if self.graph_version == 0:
                return self._initialise(stamp_ns, features, depth_m, accel_camera, attitude_up_camera)
            graph = self._catch_up()
            graph = self._level_map() or graph
            frame = self._locate(stamp_ns, features, depth_m)
            if frame is None and self.config.relocalise:
                frame = self._relocalise(stamp_ns, features, depth_m)
                graph = self._catch_up() or graph
            if frame is None:
                return self._lost(stamp_ns, graph)
            self._felt = (stamp_ns, accel_camera, attitude_up_camera)
            return self._accept(stamp_ns, frame, graph)

    def _initialise(
        self, stamp_ns: int, features: Features, depth_m: NDArray[np.float32], accel: F64 | None, attitude: F64 | None
    ) -> TrackResult:
        makes_point = (features.depth >= self.config.min_depth_m) & (features.depth <= self.config.max_depth_m)
        if np.count_nonzero(makes_point) < _MIN_START_POINTS:
            return self._result(stamp_ns, "initialising", None, [], None)
        up = self._upright.begin(accel, attitude, lambda: ground_up(depth_m, self.intrinsics))
        T_camera_map = inverse(gravity.first_pose(up))
        frame = Tracked(
            features, np.ascontiguousarray(T_camera_map[:3, :3]), T_camera_map[:3, 3].copy(),
            np.full(len(features), -1, np.int32), len(features), np.eye(6) * 1e8,
        )  # fmt: skip
        return self._accept(stamp_ns, frame, None)

    def _catch_up(self) -> GraphUpdate | None:
        """Take over what mapping has corrected since: the last frame moves with its keyframe. Return the new graph."""
        if self.mapping.revision == self._revision:
            return None
        last = self._last
        if last is not None:
            before = last.R, last.t
            T = inverse(self.mapping.keyframe_pose(self._reference) @ self._anchor)
            last.R, last.t = np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy()
            self._tell_jump(*moved(*before, last.R, last.t))
        return self._corrected()

    def _tell_jump(self, jump_m: float, jump_rad: float) -> None:
        """Count a jump when a loop moved the camera."""
        if self.loops.closed != self._closed and (jump_m > _JUMP_M or jump_rad > _JUMP_RAD):
            self._count_reset()

    def _corrected(self) -> GraphUpdate:
        """Return the graph after corrections."""
        reason: GraphReason = "loop" if self.loops.closed != self._closed else self.mapping.why
        self._revision, self._closed = self.mapping.revision, self.loops.closed
        self.graph_version += 1
        return self._graph(reason)

    def _locate(self, stamp_ns: int, features: Features, depth_m: NDArray[np.float32]) -> Tracked | None:
        """Return the frame located in the map, or None."""
        last = self._last
        if last is None:
            return None
        self._place(features, self._motion.velocity(stamp_ns))
        predicted = inverse(self._motion.predict(stamp_ns)) @ pose(last.R, last.t)
        R = orthonormal(predicted[:3, :3])
        frame = self.tracking.follow(last, features, np.ascontiguousarray(R), predicted[:3, 3].copy())
        if frame is None:
            return None
        velocity = self._motion.velocity(stamp_ns, step_between(last, frame))
        self._place(features, velocity)
        joined = self.tracking.join_map(frame, unsure=last.features.smeared)
        if joined is None or not self._enough(joined[0]):
            return None
        frame = joined[0]
        if self.shutter.learn(frame):
            self.mapping.owe()
        self._unroll(frame, velocity)
        movers.mark(self.tracking, last, frame, self._motion.since_s(stamp_ns))
        believed = self._enough(frame) and self._motion.plausible(stamp_ns, step_between(last, frame))
        blind = self._was_lost or self._motion.stale(stamp_ns)
        return frame if believed and self._verifier.believes(frame, depth_m, blind=blind) else None

    def _enough(self, frame: Tracked) -> bool:
        """Return whether so many matches of the map are left that they tell a pose."""
        left = min(frame.inliers, int(np.count_nonzero(frame.point >= 0)))
        return left >= self.config.min_inliers

    def _place(self, features: Features, velocity: Velocity) -> None:
        """Put features where and as far away as they were at the frame's moment."""
        self.shutter.straighten(features, velocity)
        self._lag.look_up(features, velocity, self.shutter.readout_s)

    def _unroll(self, frame: Tracked, velocity: Velocity) -> None:
        """Place the features by the velocity that the frame itself tells, and the pose by them."""
        if self.shutter.readout_s == 0.0:
            return
        self._place(frame.features, self.shutter.turn_rate(frame, velocity))
        self.tracking.again(frame)

    def _level_map(self) -> GraphUpdate | None:
        """Turn the map upright when gravity is known better by the last frame; return the new graph."""
        felt, self._felt = self._felt, None
        if felt is None:
            return None
        stamp_ns, accel, attitude = felt
        up = self._upright.feel(stamp_ns, self._reference, self._anchor, accel, attitude, self.mapping.keyframe_pose)
        if up is None:
            return None
        R = gravity.levelling(up, self._first_forward())
        self.mapping.turn(R)
        if self._last is not None:
            self._last.R = np.ascontiguousarray(self._last.R @ R.T)
        self._count_reset()
        self.graph_version += 1
        return self._graph("full_ba")

    def _first_forward(self) -> F64 | None:
        """Return where the map's first keyframe looks, (3,), None where it is lost: the map's x is its heading."""
        kf, first = self.atlas.keyframes, self.atlas.slots[0]
        return kf.R[first, 2] if kf.serial[first] == 0 else None

    @property
    def up_sigma_rad(self) -> float:
        """Return the doubt of the map's vertical, standard deviation."""
        return self._upright.sigma_rad

    def _relocalise(self, stamp_ns: int, features: Features, depth_m: NDArray[np.float32]) -> Tracked | None:
        """Return the frame located anywhere in the map; that is a jump, and told as one."""
        self._place(features, STILL)
        frame = self._relocation.find(stamp_ns, features, depth_m)
        if frame is None:
            return None
        if self._taken_up:
            self._taken_up, self.mapping.why = False, "restored"
            self.mapping.revision += 1
        self._last = None
        self._count_reset()
        return frame

    def _count_reset(self) -> None:
        self.reset_counter = (self.reset_counter + 1) % 256

    def _accept(self, stamp_ns: int, frame: Tracked, graph: GraphUpdate | None) -> TrackResult:
        """Remember a frame that has its pose, and make a keyframe of it when the map needs one."""
        self._motion.update(stamp_ns, None if self._last is None else step_between(self._last, frame))
        settled = self.shutter.settle(self._motion.measured)
        if settled is not None:
            self._lag.settle(self.atlas.keyframes, *settled, self.shutter.readout_s)
        else:
            self._lag.forget()
        new: list[NewKeyframe] = []
        if self._rule.wants(stamp_ns, frame, self.crew.waiting) or self.graph_version == 0:
            new, graph = self._make_keyframe(frame, graph)
        self._set_anchor(frame)
        self._last, self._was_lost = frame, False
        self._relocation.forget()
        if self._rest.begins(stamp_ns, made=bool(new)):
            self.crew.submit(self.mapping.adjust_all)
        if self._trail is not None:
            self._trail.add(stamp_ns, self._reference, self._anchor)
        return self._result(stamp_ns, "tracking", frame, new, graph)

    def _make_keyframe(self, frame: Tracked, graph: GraphUpdate | None) -> tuple[list[NewKeyframe], GraphUpdate]:
        """Put the frame into the map as a keyframe; the frame takes over what mapping has made of it."""
        k = self.mapping.insert(frame.features, frame.R, frame.t, frame.point)
        serial = self.atlas.newest_serial
        self.shutter.keep(serial, frame.features, self._motion.measured)
        if self._motion.measured is None:
            self._lag.keep()
        self.crew.submit(lambda: self._settle(k))
        kf = self.atlas.keyframes
        settled = self.mapping.revision != self._revision
        self._tell_jump(*moved(frame.R, frame.t, kf.R[k], kf.t[k]))
        frame.R, frame.t = kf.R[k].copy(), kf.t[k].copy()
        frame.point = kf.point[k, : len(frame.features)].copy()
        self._rule.made()
        if settled:
            graph = self._corrected()
        else:
            self.graph_version += 1
            graph = self._graph("keyframe" if graph is None else graph.reason)
        return [NewKeyframe(serial, inverse(pose(frame.R, frame.t)))], graph

    def _settle(self, k: int) -> None:
        """Do the mapping that a new keyframe asks for."""
        begin = time.perf_counter()
        if self.on_made is not None:
            self.on_made(k)
        self.mapping.settle(k)
        bag = self.loops.remember(k)
        if self.config.loop_closing:
            self.loops.consider(k, bag)
        if self.on_settled is not None:
            self.on_settled()
        self.settled_ms.append((time.perf_counter() - begin) * 1e3)

    @property
    def era(self) -> int:
        """Up whenever the map as a whole was turned or bent: poses of another era are of another frame."""
        return self._era0 + self.mapping.turns + self.loops.closed

    def resume(self, map_id: str, graph_version: int, reset_counter: int, up_sigma_rad: float, era: int) -> None:
        """Go on with a map that was put into the atlas: nothing is told of it until a frame is located in it."""
        self.map_id, self.graph_version, self.reset_counter = map_id, graph_version, reset_counter
        self._upright.sigma_rad, self._era0, self._taken_up = up_sigma_rad, era, True

    def follow_keyframes(self, stamps_ns: Iterable[int]) -> None:
        """Make keyframes of the frames that another run over the same frames chose: then both see the same."""
        self._rule.follow(stamps_ns)

    def _set_anchor(self, frame: Tracked) -> None:
        kf = self.atlas.keyframes
        counts = shared_counts(self.atlas.points, frame.point, len(kf.n))
        k = int(np.lexsort((-kf.serial, -counts))[0])
        self._reference = int(kf.serial[k])
        self._anchor = pose(kf.R[k], kf.t[k]) @ inverse(pose(frame.R, frame.t))

    def polish(self) -> GraphUpdate | None:
        """Adjust the whole map once, when there is time for it; return the new graph, None when there is none (yet)."""
        if len(self.atlas.slots) < 2:
            return None
        self.crew.submit(self.mapping.adjust_all)
        return self.catch_up()

    def catch_up(self) -> GraphUpdate | None:
        """Return the graph when mapping has corrected it since the last frame."""
        with self.crew.frame():
            return self._catch_up()

    def _lost(self, stamp_ns: int, graph: GraphUpdate | None) -> TrackResult:
        self._was_lost = True
        return self._result(stamp_ns, "relocalising" if self._taken_up else "lost", None, [], graph)

    def _graph(self, reason: GraphReason) -> GraphUpdate:
        return GraphUpdate(self.graph_version, reason, tuple(self.keyframe_poses().items()))

    def _result(
        self,
        stamp_ns: int,
        status: SlamStatus,
        frame: Tracked | None,
        new: list[NewKeyframe],
        graph: GraphUpdate | None,
    ) -> TrackResult:
        located = frame is not None
        return TrackResult(
            stamp_ns=stamp_ns, status=status,
            T_map_camera=inverse(pose(frame.R, frame.t)) if frame is not None else None,
            covariance=map_covariance(frame.R, frame.information) if frame is not None else None,
            keyframe_id=self._reference if located else None,
            T_keyframe_camera=self._anchor if located else None,
            new_keyframes=new, graph=graph, reset_counter=self.reset_counter, graph_version=self.graph_version,
            inliers=frame.inliers if frame is not None else 0, up_sigma_rad=self.up_sigma_rad,
        )  # fmt: skip

    def keyframe_poses(self) -> dict[int, F64]:
        """Return T_map_camera (4, 4) of each living keyframe by id, in order of id."""
        return self.atlas.keyframe_poses()

    def final_trajectory(self) -> list[tuple[int, F64]]:
        """Return (stamp_ns, T_map_camera) of each tracked frame, placed by what is now known of its keyframe."""
        return [] if self._trail is None else self._trail.placed(self.mapping.keyframe_pose)
