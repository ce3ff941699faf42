"""The scripted path in lockstep: the next frame goes out when slam and refiner answered the last."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Literal

from schemas.camera import RgbdFrame
from schemas.simulation import SimClock
from schemas.slam import Pose
from schemas.topics import SIM_CLOCK, SIM_RGBD, SIM_TRUTH, SLAM_POSE, TREES_TARGET
from schemas.trees import Target
from services.common.context import Context
from services.simulator.config import SimulatorConfig
from services.simulator.lockstep import Lockstep
from services.simulator.path import stamp_of
from services.simulator.scene import Floats
from services.simulator.source import PoseSource, ScriptedPose
from services.simulator.stage import Stage

_TICK_S = 0.05
_RETRY_S = 1.0

Phase = Literal["waiting", "running", "done"]


class Scan:
    """Moves the camera, renders, publishes, and waits."""

    def __init__(self, context: Context, config: SimulatorConfig, wall: Callable[[], float] = time.monotonic) -> None:
        self._context, self._config, self._wall = context, config, wall
        self._stage = Stage(config)
        self._source: PoseSource = ScriptedPose(self._stage.path)
        self._lockstep = Lockstep(("slam", "refiner"), config.answer_timeout_s)
        self.phase: Phase = "waiting"
        self.frames = 0
        self._ticks = 0
        self._rendered: tuple[RgbdFrame, Floats] | None = self._render()
        self._last_sent_s = -_RETRY_S
        context.on(SLAM_POSE, self._on_pose)
        context.on(TREES_TARGET, self._on_target)
        context.every_wall(_TICK_S, self.tick)

    def tick(self) -> None:
        """Send the first frames until somebody is there; later go on without those who are overdue."""
        now_s = self._wall()
        if self.phase == "running":
            late = self._lockstep.overdue(now_s)
            if late:
                self._context.health.count("lockstep_timeouts")
                names = " and ".join(late)
                text = f"{names} did not answer a frame within {self._config.answer_timeout_s:g} s: going on without"
                self._context.health.note("lockstep", f"{text}; is {names} alive?")
                self._go_on()
        elif now_s - self._last_sent_s >= _RETRY_S:
            self._last_sent_s = now_s
            if self._rendered is not None:
                self._context.health.note("lockstep", "waiting for slam and refiner to answer the first frame")
                self._send(*self._rendered)
            else:
                self._publish_clock(self._last_stamp_ns())

    def _on_pose(self, message: Pose) -> None:
        self._answered("slam", message.stamp_ns)

    def _on_target(self, message: Target) -> None:
        self._answered("refiner", message.stamp_ns)

    def _answered(self, service: str, stamp_ns: int) -> None:
        if not self._lockstep.answered(service, stamp_ns):
            return
        self._context.health.note("lockstep", "")
        if self.phase == "waiting":
            self.phase = "running"
        self._go_on()

    def _go_on(self) -> None:
        """Send the next frame, or end."""
        if self._rendered is None:
            self.phase = "done"
            self._publish_clock(self._last_stamp_ns())
        else:
            self._send(*self._rendered)

    def _send(self, frame: RgbdFrame, T_world_camera: Floats) -> None:
        """Move time on to a frame and publish it; then render the next, while the services work on this one."""
        self._step_clock(frame.stamp_ns)
        self._stage.touches.update(self._stage.world.clearance(T_world_camera[:3, 3]))
        self._context.publish(SIM_TRUTH, self._stage.truth(T_world_camera, frame.seq, frame.stamp_ns))
        self._context.publish(SIM_RGBD, frame)
        self._lockstep.sent(frame.stamp_ns, self._wall())
        self.frames += 1
        self._context.health.count("frames")
        if self.phase == "running":
            self._advance()
        elif self.phase == "waiting":  # the camera rests, time goes on: a frame of the same stamp could be refused
            self._rendered = self._render()

    def _advance(self) -> None:
        """Make the next frame, or none at the path's end."""
        if self._source.done:
            self._rendered = None
            return
        self._source.advance(1.0 / self._config.rate_hz)
        self._rendered = self._render()

    def _step_clock(self, stamp_ns: int) -> None:
        """Publish the steps of time from the last frame up to ``stamp_ns``, so that timers fire in between."""
        step_ns = round(1e9 / self._config.clock_rate_hz)
        for between_ns in range(self._last_stamp_ns() + step_ns, stamp_ns, step_ns):
            self._publish_clock(between_ns)
        self._publish_clock(stamp_ns)

    def _last_stamp_ns(self) -> int:
        return stamp_of(max(0, self.frames - 1), self._config.rate_hz)

    def _publish_clock(self, stamp_ns: int) -> None:
        clock = SimClock(stamp_ns=stamp_ns, seq=self._ticks, phase=self.phase, frames=self.frames)
        self._ticks += 1
        self._context.publish(SIM_CLOCK, clock)

    def _render(self) -> tuple[RgbdFrame, Floats]:
        """Return the frame at the present pose, to be sent as number ``frames``."""
        T_world_camera = self._source.pose()
        with self._context.health.timed("render"):
            stamp_ns = stamp_of(self.frames, self._config.rate_hz)
            frame = self._stage.frame(T_world_camera, self._source.acceleration(), self.frames, stamp_ns)
        return frame, T_world_camera
