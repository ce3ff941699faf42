"""In real time on a PX4 that runs elsewhere: its true pose (HIL_STATE_QUATERNION) carries our camera."""

from __future__ import annotations

import subprocess
import sys
import time
from collections import deque
from os import getpid

import numpy as np
from pymavlink.dialects.v20 import common as m

from schemas.topics import SIM_RGBD, SIM_TRUTH
from services.common.context import Context
from services.common.errors import InputError
from services.common.geometry import Matrix, pose, rotation_z
from services.common.mount import Mount
from services.simulator.config import SimulatorConfig
from services.simulator.px4.frames import FLIP, rotation_from_wxyz
from services.simulator.px4.geodesy import to_local
from services.simulator.relay import Endpoint
from services.simulator.stage import Stage

_TURN_S = 0.004
_STAMP_BYTES = 8
_SMOOTHING = 0.25
"""Share of a told position's deviation from the predicted one that is taken over: it resolves 1.1 cm only."""
_JUMP_M = 1.0
_WINDOW_S = 0.25
"""Accelerations are slopes over this long: the told speeds are whole centimetres per second."""


class TruthTrack:
    """The aircraft's true pose in our world, ``T_world_body`` (4, 4) FLU, from HIL_STATE_QUATERNION.

    The first whole message is taken for the start: its place and heading become ``T_world_start``'s. The messages carry
    no stamp (PX4 leaves ``time_usec`` at 0): their time is that of their arrival.
    """

    def __init__(self, T_world_start: Matrix) -> None:
        self._T_world_start = T_world_start
        self._origin: tuple[float, float, float] | None = None
        self._T_world_local = np.eye(4)
        self._position_m = np.zeros(3)
        self._time_s = 0.0
        self.acceleration_m_s2 = np.zeros(3)
        """Of the body in the world, gravity not included."""
        self._velocity_m_s = np.zeros(3)
        self._window: deque[tuple[float, Matrix]] = deque()

    def take(self, told: m.MAVLink_hil_state_quaternion_message, time_s: float) -> Matrix | None:
        """Take a message that arrived at ``time_s`` and return the pose; None while it does not hold one yet.

        A PX4 that boots tells zeros for what it does not know: a quaternion without length, the place 0, 0.
        """
        if not 0.9 < float(np.linalg.norm(told.attitude_quaternion)) < 1.1 or (told.lat == 0 and told.lon == 0):
            return None
        place = (told.lat * 1e-7, told.lon * 1e-7, told.alt * 1e-3)
        R = FLIP @ rotation_from_wxyz(np.array(told.attitude_quaternion)) @ FLIP
        velocity = FLIP @ np.array([told.vx, told.vy, told.vz]) * 0.01
        if self._origin is None:
            self._origin, self._position_m = place, np.zeros(3)
            turn = np.arctan2(self._T_world_start[1, 0], self._T_world_start[0, 0]) - np.arctan2(R[1, 0], R[0, 0])
            self._T_world_local = pose(rotation_z(float(turn)), self._T_world_start[:3, 3])
        else:
            self._follow(FLIP @ np.array(to_local(self._origin, place)), velocity, time_s - self._time_s)
        self._time_s, self._velocity_m_s = time_s, velocity
        self._accelerate(time_s, velocity)
        return self._T_world_local @ pose(R, self._position_m)

    def _follow(self, told_m: Matrix, velocity_m_s: Matrix, dt_s: float) -> None:
        dt_s = min(max(dt_s, 0.0), 0.5)
        predicted = self._position_m + 0.5 * (velocity_m_s + self._velocity_m_s) * dt_s
        off = told_m - predicted
        self._position_m = told_m if np.linalg.norm(off) > _JUMP_M else predicted + _SMOOTHING * off

    def _accelerate(self, time_s: float, velocity_m_s: Matrix) -> None:
        """Take the slope of the speeds of the last moments."""
        self._window.append((time_s, velocity_m_s))
        while time_s - self._window[0][0] > _WINDOW_S:
            self._window.popleft()
        t = np.array([at for at, _ in self._window])
        t -= t.mean()
        spread = float(t @ t)
        slope = t @ np.array([v for _, v in self._window]) / spread if spread > 1e-6 else np.zeros(3)
        self.acceleration_m_s2 = self._T_world_local[:3, :3] @ slope


class ExternalFlight:
    """Renders at the rate that the machine holds, from the newest true pose, stamped with its arrival."""

    def __init__(self, context: Context, config: SimulatorConfig) -> None:
        self._context, self._config = context, config
        self.stage = Stage(config)
        scene, legs_m = self.stage.scene, config.px4.airframe.leg_height_m
        start = pose(rotation_z(scene.start_yaw_rad), (0.0, 0.0, scene.ground.at(0.0, 0.0) + legs_m))
        autopilot = context.config.autopilot
        mount = Mount.level(autopilot.camera_offset_m, autopilot.camera_pitch_rad, autopilot.camera_yaw_rad)
        self._T_body_camera = mount.T_body_camera
        self.stage.begin_map(start @ self._T_body_camera)
        self._track = TruthTrack(start)
        self._parser = m.MAVLink(None)
        self._parser.robust_parsing = True
        self._T_world_body: Matrix | None = None
        self._stamp_ns = self._sent_ns = -1
        self._due_ns = 0
        self.frames = 0
        self._truth = Endpoint.opened("udpin:127.0.0.1:0")
        self._relay = self._started_relay()
        context.on_stop(self._close)
        context.every_wall(_TURN_S, self.turn)
        context.every_wall(1.0, self._tell)

    def _started_relay(self) -> subprocess.Popen[bytes]:
        e = self._config.external
        try:  # told here, in one line, rather than by the relay
            Endpoint.opened(e.endpoint).bound.close()
        except (OSError, ValueError, OverflowError) as error:
            raise InputError(f"simulator.external.endpoint {e.endpoint!r}: {error}") from error
        port = self._truth.bound.getsockname()[1]
        command = [sys.executable, "-m", "services.simulator.relay", e.endpoint, e.bridge, f"udpout:127.0.0.1:{port}",
                   str(e.truth_rate_hz), str(getpid())]  # fmt: skip
        return subprocess.Popen(command, stdin=subprocess.DEVNULL)

    def _close(self) -> None:
        self._relay.terminate()
        self._truth.bound.close()

    def turn(self) -> None:
        """Take the truth that came; render and send a frame when one is due."""
        while (data := self._truth.receive()) is not None:
            stamp_ns = int.from_bytes(data[:_STAMP_BYTES], "little")
            for message in self._parser.parse_buffer(data[_STAMP_BYTES:]) or ():
                if isinstance(message, m.MAVLink_hil_state_quaternion_message):
                    T_world_body = self._track.take(message, stamp_ns * 1e-9)
                    if T_world_body is None:
                        continue
                    self._T_world_body = T_world_body
                    self._stamp_ns = stamp_ns + self._context.clock.now_ns() - time.monotonic_ns()
        if self._T_world_body is not None and self._stamp_ns > self._sent_ns and self._stamp_ns >= self._due_ns:
            self._send(self._T_world_body)

    def _send(self, T_world_body: Matrix) -> None:
        T_world_camera, stamp_ns = T_world_body @ self._T_body_camera, self._stamp_ns
        self.stage.touches.update(self.stage.world.clearance_of_things(T_world_camera[:3, 3]))
        with self._context.health.timed("render"):
            frame = self.stage.frame(T_world_camera, self._track.acceleration_m_s2, self.frames, stamp_ns)
        self._context.publish(SIM_TRUTH, self.stage.truth(T_world_camera, frame.seq, stamp_ns))
        self._context.publish(SIM_RGBD, frame)
        self.frames += 1
        self._context.health.count("frames")
        self._sent_ns = stamp_ns
        self._due_ns = (
            stamp_ns + round(1e9 / self._config.rate_hz) - round(1e9 / self._config.external.truth_rate_hz / 2)
        )

    def _tell(self) -> None:
        e, book = self._config.external, self._context.health
        silent_s = (self._context.clock.now_ns() - self._stamp_ns) * 1e-9
        if self._relay.poll() is not None:
            book.note("relay", f"it ended with exit code {self._relay.returncode}: restart the simulator")
        silent = f"no true pose from {e.endpoint}: does PX4 in simulation run, and speak MAVLink there?"
        book.note("px4", silent if silent_s > e.truth_silent_s else "")
        book.counters["touches"] = self.stage.touches.count
