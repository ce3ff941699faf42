"""The closed loop: camera on the simulated aircraft, time in lockstep with those who fly it.

Simulated time moves in steps of 10 ms. It is never more than ``lead_s`` ahead of autopilot and navigator, and the next
frame waits for slam and refiner to have answered the last; meanwhile it is rendered. Nobody dead is waited for, and a
hung one only for ``hung_after_s``; while somebody is missing, simulated time is no faster than the wall's.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Literal

import numpy as np

from schemas.camera import RgbdFrame
from schemas.navigation import Guidance
from schemas.simulation import SimClock
from schemas.slam import Pose
from schemas.topics import (
    MISSION_GUIDANCE,
    SECOND_POSE,
    SIM_CLOCK,
    SIM_RGBD,
    SIM_SECOND,
    SIM_TRUTH,
    SLAM_POSE,
    TREES_TARGET,
    VEHICLE_STATE,
)
from schemas.trees import Target
from schemas.vehicle import VehicleState
from services.common.context import Context
from services.common.geometry import pose, rotation_z
from services.common.mount import Mount
from services.simulator.config import SimulatorConfig
from services.simulator.followers import Follower, Followers
from services.simulator.path import START_STAMP_NS
from services.simulator.px4.modes import NavState
from services.simulator.px4.pose_source import FlyingCamera
from services.simulator.px4.simulated import SimulatedPx4
from services.simulator.px4.warm import warm
from services.simulator.scene import Floats, Scene
from services.simulator.stage import Stage

LOG = logging.getLogger(__name__)

_TURN_S = 0.002
"""Wall time between two steps at least: the bridge has its say in between."""
_MOST_CREDIT_S = 0.08
_SEES = ("slam", "refiner")
_STEERS = ("autopilot", "navigator")
_SECOND = "second_slam"
_FLOWN_M = 0.5
_LANDING = frozenset({NavState.LAND, NavState.DESCEND, NavState.RETURN})

Phase = Literal["waiting", "running", "done"]


def simulated_px4(scene: Scene, config: SimulatorConfig) -> SimulatedPx4:
    """Return the simulated aircraft standing at its start."""
    x, y = config.start_m
    z = float(scene.ground.at(x, y)) + config.px4.airframe.leg_height_m
    T_world_body = pose(rotation_z(scene.start_yaw_rad), (x, y, z))
    return SimulatedPx4(scene.ground.at, T_world_body, config.px4, config.seed)


class Flight:
    """Lets time pass, renders, publishes and waits."""

    def __init__(
        self, context: Context, config: SimulatorConfig, wall: Callable[[], float] = time.monotonic,
        px4: SimulatedPx4 | None = None,
    ) -> None:  # fmt: skip
        self._context, self._config, self._wall = context, config, wall
        second = context.config.fusion.second
        self._two_cameras = context.config.fusion.enabled and second.enabled
        self.stage = Stage(config, second=self._two_cameras)
        warm()
        self.px4 = px4 or simulated_px4(self.stage.scene, config)
        if px4 is None:
            self.px4.open_links()
            context.on_stop(self.px4.close)
        autopilot = context.config.autopilot
        first = Mount.level(autopilot.camera_offset_m, autopilot.camera_pitch_rad, autopilot.camera_yaw_rad)
        self.camera = FlyingCamera(self.px4, first)
        self._T_body_second = Mount.level(second.offset_m, second.pitch_rad, second.yaw_rad).T_body_camera
        self.stage.begin_map(self.camera.pose())
        seen = Follower("slam", ("camera",)), Follower("refiner", ("camera", "slam"))
        below = [Follower(_SECOND, ("second_camera",))] if self._two_cameras else []
        self._sees = (*_SEES, *(follower.name for follower in below))
        followers = [*seen, *below, *map(Follower, _STEERS)]
        self._followers = Followers(followers, context.alive, config.flight.hung_after_s)
        self.phase: Phase = "waiting"
        self.frames = 0
        self._ticks = 0
        self._flown = False
        self._frame_ns = -1
        """Stamp of the last frame sent."""
        self._due_ns = float(START_STAMP_NS)
        self._lottery = np.random.default_rng([config.seed, 303])
        self._dropped = False
        self._rendered: tuple[RgbdFrame, Floats, RgbdFrame | None] | None = None
        self._credit_s, self._earned_at_s = 0.0, wall()
        self._listen()

    def _listen(self) -> None:
        c = self._context
        c.on(SLAM_POSE, self._on_pose)
        c.on(TREES_TARGET, self._on_target)
        if self._two_cameras:
            c.on(SECOND_POSE, self._on_second)
        c.on(MISSION_GUIDANCE, self._on_guidance)
        c.on(VEHICLE_STATE, self._on_vehicle)
        c.every_wall(_TURN_S, self.turn)
        c.every_wall(1.0, self._tell)

    def _on_pose(self, message: Pose) -> None:
        self._followers.answered("slam", message.stamp_ns)

    def _on_second(self, message: Pose) -> None:
        self._followers.answered(_SECOND, message.stamp_ns)

    def _on_target(self, message: Target) -> None:
        self._followers.answered("refiner", message.stamp_ns)

    def _on_guidance(self, message: Guidance) -> None:
        self._followers.answered("navigator", message.stamp_ns)

    def _on_vehicle(self, message: VehicleState) -> None:
        self._followers.answered("autopilot", message.stamp_ns)

    @property
    def now_ns(self) -> int:
        """Simulated time: the physics', to the tick."""
        return START_STAMP_NS + round(self.px4.elapsed_s * 1e6) * 1000

    # -- time ---------------------------------------------------------------------------------------------------
    def turn(self) -> None:
        """Render or send a frame, or make one step of time, when it is allowed."""
        if self.phase == "done":
            return
        now_s = self._wall()
        self._earn(now_s)
        if self.frames == 0 and self._awaited:
            return
        if self._rendered is None and self.now_ns >= self._due_ns:
            self._rendered = self._render()
        elif self._rendered is not None and self._dropped:
            self._rendered, self._dropped = None, self._drops()
            self._due_ns += 1e9 / self._config.rate_hz
        elif self._rendered is not None:
            if not self._followers.waits(self._sees, self._frame_ns, now_s):
                self._send(*self._rendered)
        elif self._credit_s > 0.0 and not self._ahead(now_s):
            self._step()

    @property
    def _awaited(self) -> tuple[str, ...]:
        """Those who must live before time begins, and do not yet."""
        return tuple(name for name in self._config.flight.wait_for if not self._context.alive(name))

    def _earn(self, now_s: float) -> None:
        """Save up the simulated time that the wall's allows, not much of it."""
        speed = self._config.flight.max_speed
        if not self._followers.complete:
            speed = min(speed, 1.0)
        earned_s = speed * (now_s - self._earned_at_s)
        self._credit_s, self._earned_at_s = min(self._credit_s + earned_s, _MOST_CREDIT_S), now_s

    def _ahead(self, now_s: float) -> bool:
        heard_ns = self.now_ns - round(self._config.flight.lead_s * 1e9)
        return self._followers.waits(_STEERS, heard_ns, now_s)

    def _step(self) -> None:
        before_s = self.px4.elapsed_s
        with self._context.health.timed("physics"):
            T_world_camera = self.camera.advance(1.0 / self._config.clock_rate_hz)
            self._feel(T_world_camera)
        self._credit_s -= self.px4.elapsed_s - before_s
        over = self.camera.done and not self._config.flight.again
        if over or self.px4.elapsed_s > self._config.flight.limit_s:
            self.phase = "done"
        self._publish_clock()

    def _feel(self, T_world_camera: Floats) -> None:
        """Count touches of things, and of the ground where it was not meant."""
        x, y, z = (float(v) for v in T_world_camera[:3, 3])
        self._flown = self._flown or z - self.stage.scene.ground.at(x, y) > _FLOWN_M
        if self.px4.on_ground and not self.px4.armed:
            self._flown = False  # armed once more it stands, and has not come down
        bumped = self._flown and self.px4.on_ground and self.px4.armed and self.px4.mode not in _LANDING
        clearance_m = self.stage.world.clearance_of_things(T_world_camera[:3, 3])
        if self.stage.touches.update(clearance_m, bumped=bumped):
            what = "the ground" if bumped else f"something, {clearance_m:.2f} m from the camera"
            mode, phase_s = self.px4.mode.name.lower(), self.px4.elapsed_s
            LOG.warning("touched %s at (%.2f, %.2f, %.2f) m in mode %s after %.2f s", what, x, y, z, mode, phase_s)

    def _publish_clock(self) -> None:
        self._ticks += 1
        clock = SimClock(stamp_ns=self.now_ns, seq=self._ticks, phase=self.phase, frames=self.frames)
        self._context.publish(SIM_CLOCK, clock)

    # -- frames -------------------------------------------------------------------------------------------------
    def _render(self) -> tuple[RgbdFrame, Floats, RgbdFrame | None]:
        """Return the frame of this moment, and the second camera's if there is one."""
        T_world_camera, felt = self.camera.pose(), self.camera.acceleration()
        T_world_second = self.px4.true_pose() @ self._T_body_second
        with self._context.health.timed("render"):
            frame = self.stage.frame(T_world_camera, felt, self.frames, self.now_ns)
            second = self.stage.second_frame(T_world_second, felt, self.frames, self.now_ns)
        return frame, T_world_camera, second

    def _send(self, frame: RgbdFrame, T_world_camera: Floats, second: RgbdFrame | None) -> None:
        """Publish a frame with its truth; the flight has begun once somebody answers frames."""
        self._rendered, self._frame_ns, self._dropped = None, frame.stamp_ns, self._drops()
        self._context.publish(SIM_TRUTH, self.stage.truth(T_world_camera, frame.seq, frame.stamp_ns))
        self._context.publish(SIM_RGBD, frame)
        if second is not None:
            self._context.publish(SIM_SECOND, second)
        self.frames += 1
        self._context.health.count("frames")
        self._due_ns += 1e9 / self._config.rate_hz
        if self.phase == "waiting" and self._followers.complete:
            self.phase = "running"

    def _drops(self) -> bool:
        """Draw whether the next frame never arrives; none is lost before the flight has begun."""
        return self.phase == "running" and bool(self._lottery.random() < self._config.flight.drop_share)

    def _tell(self) -> None:
        """Say whom time does not wait for."""
        if self.phase != "running":
            self._publish_clock()
        f, book = self._followers, self._context.health
        book.counters["lockstep_timeouts"] = f.timeouts
        hung = f"{' and '.join(f.hung)} did not answer for {self._config.flight.hung_after_s:g} s" if f.hung else ""
        lost = [name for name in f.missing if name not in f.hung] if self.phase == "running" else []
        missing = f"{' and '.join(lost)} not there" if lost else ""
        words = ", ".join(word for word in (hung, missing) if word)
        if self.frames == 0:
            book.note("lockstep", f"time begins when {', '.join(self._awaited)} are ready")
        else:
            book.note("lockstep", f"{words}: time goes on without" if words else "")
        book.counters["touches"] = self.stage.touches.count
