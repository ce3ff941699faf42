"""What the mission knows at one step: inputs, and the estimates it keeps from step to step. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from schemas.trees import Target, Tree
from schemas.vehicle import VehicleState
from services.common.geometry import Matrix, wrap_angle
from services.navigator.claiming import Claims
from services.navigator.config import NavigatorConfig
from services.navigator.docking import DockMonitor
from services.navigator.following import Following
from services.navigator.path import Disc, line_clearance_m
from services.navigator.selection import axis_at
from services.navigator.surroundings import Surroundings
from services.navigator.track import Correction, PoseTrack, Sample, Step, TrackLimits
from services.navigator.trajectory import Fence, Trajectory
from services.navigator.underfoot import foot_left_m
from services.navigator.values import Inputs

_BARK_MARGIN_M, _TARGET_BARK_M = 0.30, 0.45
"""Surfaces this near to a listed trunk's bark, or to the target's axis, are the trunk."""
_SCAN_BINS = 36
_HIDING_MARGIN_M = 0.10
_LEAST_FENCE_M = 2.0


@dataclass
class Board:
    """The mission's memory. Everything in map coordinates follows a correction of the map."""

    config: NavigatorConfig
    track: PoseTrack = field(init=False)
    trajectory: Trajectory = field(init=False)
    dock: DockMonitor = field(init=False)
    claims: Claims = field(init=False)
    inputs: Inputs = field(default_factory=lambda: Inputs(0))
    step_kind: Step = Step.STALE
    """Of the pose taken at this step."""
    began_ns: int = 0
    """Time of the first step."""
    correction: Correction | None = None
    home_m: Matrix | None = None
    home_known: bool = True
    map_changed: bool = False
    """The map was changed in flight: what was scanned is gone."""
    target_id: int | None = None
    axis_m: Matrix | None = None
    """Filtered trunk axis x, y (2,) of the target."""
    ground_z_m: float = 0.0
    """Of the target's foot."""
    left_foot_m: Matrix | None = None
    """Foot (3,) of the tree left last: the aircraft may still hang over that ground."""
    visited_ids: list[int] = field(default_factory=list)
    given_up_ids: list[int] = field(default_factory=list)
    done_xy_m: list[Matrix] = field(default_factory=list)
    wanted_id: int | None = None
    docked_count: int = 0
    trees_wanted: int = 1
    scan_seen: set[int] = field(default_factory=set)
    scan_turned_rad: float = 0.0
    scan_sure_yaw_rad: float | None = None
    """The last heading (unwrapped) at which slam was sure of itself."""
    scan_slow_until_rad: float = 0.0
    relocking: bool = False
    relocks: int = 0
    relocked_at_rad: float = 0.0
    homeward: bool = False
    """No further tree: the way leads to the start."""
    giving_way: bool = False
    """Flies to its start to make room for others, and chooses on from there."""
    over_start_s: float = 0.0
    """For how long it has been at rest over the start, on its way back."""
    dock_direction: Matrix | None = None
    """Unit vector (2,) from the axis to the docking place."""
    dock_offset_m: float = 0.0
    dock_yaw_rad: float = 0.0
    corners: list[Matrix] = field(default_factory=list)
    planned_ns: int = -1
    dt_s: float = 0.0
    target_seen_ns: int | None = None
    """When the target was last tracked in the depth image."""
    target_since_ns: int = 0
    """When the target was chosen."""
    looking: bool = False
    """Turned away from the target on purpose, to look along the way."""
    look_since_ns: int = 0
    """Since when it has faced that way."""
    battery_known_ns: int | None = None
    """When the vehicle last told the battery's share."""
    battery_silence_told: bool = False
    around: Surroundings = field(default_factory=Surroundings)
    following: Following = field(default_factory=Following)

    def __post_init__(self) -> None:
        f = self.config.failsafe
        self.track = PoseTrack(TrackLimits(jump_m=f.pose_jump_m, jump_rad=f.pose_jump_rad))
        self.trajectory = Trajectory(self.config.motion)
        self.dock = DockMonitor(self.config.dock)
        self.claims = Claims(self.config.claims)

    # -- what is known ------------------------------------------------------------------------------------------
    @property
    def now_ns(self) -> int:
        """The step's time."""
        return self.inputs.now_ns

    @property
    def here(self) -> Sample | None:
        """The last tracked pose while slam is trusted, else None."""
        fresh = self.inputs.age_s(self.inputs.pose) <= self.config.failsafe.pose_silent_s
        return self.track.latest if fresh and not self.track.lost and not self.poses_late else None

    @property
    def pose_age_s(self) -> float:
        """Seconds since the image of the last tracked pose was taken, infinite before the first."""
        last = self.track.latest
        return float("inf") if last is None else (self.now_ns - last.stamp_ns) / 1e9

    @property
    def poses_late(self) -> bool:
        """Whether poses come, but of where the aircraft was: over a link that queues, or of a slam that cannot keep up."""
        return not self.track.lost and self.pose_age_s > self.config.failsafe.pose_late_s

    @property
    def from_home_m(self) -> float:
        """Horizontal distance from the start; infinite while either place is not known."""
        if self.here is None or self.home_m is None:
            return float("inf")
        return float(np.linalg.norm(self.here.position_m[:2] - self.home_m[:2]))

    @property
    def carried(self) -> bool:
        """Whether slam is lost and fusion carries the pose on: good enough to brake by, never to go anywhere."""
        seen = self.inputs.pose
        fresh = self.inputs.age_s(seen) <= self.config.failsafe.pose_silent_s
        return seen is not None and fresh and seen.message.status == "dead_reckoned"

    @property
    def blind_s(self) -> float:
        """Seconds since the last tracked pose came, or since we began to look for one."""
        last = self.track.latest
        since_ns = max(self.began_ns, 0 if last is None else last.received_ns)
        return (self.now_ns - since_ns) / 1e9

    @property
    def vehicle(self) -> VehicleState | None:
        """The vehicle while its word is fresh."""
        seen = self.inputs.vehicle
        if seen is None or self.inputs.age_s(seen) > self.config.failsafe.vehicle_silent_s:
            return None
        return seen.message if seen.message.connected else None

    @property
    def trees(self) -> tuple[Tree, ...]:
        """The listed trees of the present map."""
        seen, last = self.inputs.trees, self.track.latest
        if seen is None or last is None or seen.message.map_id != last.map_id:
            return ()
        return seen.message.trees

    @property
    def target(self) -> Target | None:
        """The chosen tree in the depth image while it is tracked and fresh, else None."""
        seen, last = self.inputs.target, self.track.latest
        if seen is None or last is None or self.inputs.age_s(seen) > self.config.failsafe.target_lost_s:
            return None
        t = seen.message
        wrong = t.status != "tracking" or t.tree_id != self.target_id or t.map_id != last.map_id
        return None if wrong or self.following.off_gate or t.range_m is None or t.bearing_rad is None else t

    @property
    def hidden(self) -> bool:
        """Whether another mapped trunk stands between the camera and the target."""
        here = self.here
        if here is None or self.axis_m is None:
            return False
        return line_clearance_m(here.position_m[:2], self.axis_m, self.discs(_HIDING_MARGIN_M)) < 0.0

    @property
    def refiner_silent(self) -> bool:
        """Whether the refiner says nothing at all; alive, it speaks of every frame, whether it sees the target or not."""
        seen = self.inputs.target
        return seen is None or self.inputs.age_s(seen) > self.config.failsafe.target_lost_s

    @property
    def target_lost(self) -> bool:
        """Whether the target has been out of sight for longer than single missed frames last."""
        if self.target_seen_ns is None:
            return True
        return (self.now_ns - self.target_seen_ns) / 1e9 > self.config.failsafe.target_lost_s

    @property
    def flight_z_m(self) -> float:
        """Height of the camera in map for level flight; higher when the target stands uphill."""
        home_z = 0.0 if self.home_m is None else float(self.home_m[2])
        level = home_z + self.config.flight_height_m - self.config.start_height_m
        if self.axis_m is None:
            return level
        return min(max(level, self.ground_z_m + self.config.min_ground_m), self.ceiling_z_m)

    @property
    def ceiling_z_m(self) -> float:
        """The greatest height of the camera in map."""
        return (0.0 if self.home_m is None else float(self.home_m[2])) + self.config.motion.fence_height_m

    def discs(self, keep_out_m: float) -> list[Disc]:
        """Return what is in the way but the target, grown by ``keep_out_m``: listed trunks, seen things, moving ones."""
        z = self.flight_z_m
        astray = bool(self.following.astray)
        places = [(axis_at(t, z), t) for t in self.trees if astray or t.id != self.target_id]
        mapped = [Disc(float(p[0]), float(p[1]), t.radius_m + keep_out_m) for p, t in places]
        return mapped + (self.around.discs(keep_out_m, self.now_ns) if self.config.live_guard else [])

    def _look_around(self) -> None:
        """Take the view into what is known of the space around; trunks are explained by the map."""
        here, seen = self.here, self.inputs.view
        if here is None or not self.config.live_guard:
            return
        if self.trajectory.fence is not None:
            self.around.space.visit(here.position_m[:2])
        if seen is None or seen.message.map_key is None:
            return
        z = self.flight_z_m
        trunks = [(axis_at(t, z), t.radius_m + _BARK_MARGIN_M) for t in self.trees]
        if self.axis_m is not None:
            trunks.append((self.axis_m, _TARGET_BARK_M))
        known = [Disc(float(p[0]), float(p[1]), r) for p, r in trunks]
        self.around.take(seen.message, (here.map_id, here.reset_counter), known)

    @property
    def fence_disc(self) -> Disc | None:
        """The geofence from above."""
        fence = self.trajectory.fence
        if fence is None:
            return None
        return Disc(float(fence.centre_m[0]), float(fence.centre_m[1]), fence.radius_m)

    def to_axis(self) -> tuple[float, float] | None:
        """Return believed distance (m) to the target's axis and its bearing (rad, positive left), or None."""
        t, here = self.target, self.here
        if t is not None and t.measured and t.range_m is not None and t.bearing_rad is not None:
            return t.range_m, t.bearing_rad
        if here is None or self.axis_m is None:
            return None
        offset = self.axis_m - here.position_m[:2]
        return float(np.linalg.norm(offset)), wrap_angle(float(np.arctan2(offset[1], offset[0])) - here.yaw_rad)

    # -- keeping it current -------------------------------------------------------------------------------------
    def observe(self, inputs: Inputs) -> None:
        """Take a step's inputs."""
        self.began_ns = self.began_ns or inputs.now_ns
        if self.inputs.now_ns:
            self.dt_s = min(max((inputs.now_ns - self.inputs.now_ns) / 1e9, 0.0), 0.2)
        self.inputs, self.correction, self.step_kind = inputs, None, Step.STALE
        self.claims.take(inputs.claims, inputs.now_ns)
        if self.vehicle is not None and self.vehicle.battery_share is not None:
            self.battery_known_ns = inputs.now_ns
        before = self.track.latest
        if inputs.pose is not None:
            self.step_kind = self.track.add(inputs.pose.message, inputs.pose.received_ns)
            self.correction = self.track.correction
        if self.correction is not None:
            self._correct(self.correction)
        after = self.track.latest
        if before is not None and after is not None and after.map_id != before.map_id:
            self._drop_map(before, after)
        if self.here is not None and self.step_kind not in (Step.STALE, Step.LOST):
            self._count_scan(self.here)
        self._look_around()
        self.following.list_changed(self)
        self.following.target_seen(self)

    def choose(self, tree: Tree) -> None:
        """Make a listed tree the target."""
        self.target_id, self.wanted_id = tree.id, None
        self.following.list_version, self.following.astray = -1, ""
        self.target_since_ns, self.looking = self.now_ns, False
        self.ground_z_m = tree.z_m
        self.axis_m, self.target_seen_ns = np.array([tree.x_m, tree.y_m]), None
        self.axis_m = axis_at(tree, self.flight_z_m)  # with a target it is the height that the list is compared at
        self.dock.clear()
        self.dock_direction, self.corners, self.planned_ns = None, [], -1
        self.dock_offset_m = self.dock_yaw_rad = 0.0

    def finish_target(self, *, visited: bool) -> None:
        """Put the target among the visited or the given-up trees."""
        if self.target_id is None:
            return
        (self.visited_ids if visited else self.given_up_ids).append(self.target_id)
        if self.axis_m is not None:
            self.done_xy_m.append(self.axis_m.copy())
        self.docked_count += int(visited)
        self.claims.done |= visited

    def further_tree(self) -> None:
        """Want one more tree than were done, instead of the way home."""
        self.trees_wanted, self.homeward, self.giving_way = max(self.trees_wanted, self.docked_count + 1), False, False

    def drop_target(self) -> None:
        """Have no target any more."""
        self.left_foot_m = foot_left_m(self)
        self.target_id, self.axis_m, self.dock_direction, self.target_seen_ns = None, None, None, None
        self.looking, self.following.astray = False, ""
        self.dock.clear()

    def _correct(self, c: Correction) -> None:
        def flat(p: Matrix) -> Matrix:
            return c.point(np.array([p[0], p[1], 0.0]))[:2]

        self.trajectory.correct(c)
        self.around.correct(c)
        if self.home_m is not None:
            self.home_m = c.point(self.home_m)
        if self.left_foot_m is not None:
            self.left_foot_m = c.point(self.left_foot_m)
        if self.axis_m is not None:
            self.axis_m = flat(self.axis_m)
        if self.dock_direction is not None:
            self.dock_direction = c.vector(np.array([*self.dock_direction, 0.0]))[:2]
        self.ground_z_m += float(c.shift_m[2])
        self.done_xy_m = [flat(p) for p in self.done_xy_m]
        self.corners, self.planned_ns = [], -1
        self.dock.clear()

    def _drop_map(self, before: Sample, after: Sample) -> None:
        """Go over to another map: nothing known by id is valid in it, and coordinates only where a correction is known.

        Without one the start's height is carried over by the height flown, and the fence shrinks by the distance
        flown, so that no chain of new maps walks the aircraft away.
        """
        self.drop_target()
        self.visited_ids, self.given_up_ids = [], []
        self.wanted_id = None
        self.claims.forget()
        self.scan_seen.clear()
        self.scan_turned_rad = 0.0
        self.map_changed = True
        if self.correction is not None:
            return
        self.around = Surroundings()
        self.done_xy_m = []
        self.home_known = False
        moved = after.position_m - before.position_m
        if self.home_m is not None:
            self.home_m = self.home_m + moved
        if self.left_foot_m is not None:
            self.left_foot_m = self.left_foot_m + moved
        fence = self.trajectory.fence
        if fence is not None:
            flown = float(np.linalg.norm(before.position_m[:2] - fence.centre_m[:2]))
            radius = max(fence.radius_m - flown, _LEAST_FENCE_M)
            floor_z_m = fence.floor_z_m + float(moved[2])
            self.trajectory.fence = Fence(after.position_m.copy(), floor_z_m, radius, fence.height_m)

    def _count_scan(self, here: Sample) -> None:
        self.scan_seen.add(int((here.yaw_rad + np.pi) / (2.0 * np.pi) * _SCAN_BINS) % _SCAN_BINS)

    @property
    def scan_gaps(self) -> int:
        """How many of the 10-degree headings no tracked frame has looked along."""
        return _SCAN_BINS - len(self.scan_seen)
