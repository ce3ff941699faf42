"""Our own bridge flies the simulated autopilot: in one process, in simulated time, on delayed and noisy poses."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from schemas.navigation import Guidance, Setpoint
from schemas.slam import Pose
from services.common.geometry import Matrix, camera_yaw, inverse, pose, to_transform
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.link import Codec
from services.simulator.px4.config import Px4Config
from services.simulator.px4.inprocess import InProcessLink
from services.simulator.px4.modes import NavState
from services.simulator.px4.pose_source import FlyingCamera
from services.simulator.px4.simulated import SimulatedPx4

TICK_S = 0.004
FRAME_S = 1.0 / 15.0
START_NS = 1_000_000_000
COVARIANCE = tuple(float(v) for v in np.diag([1e-4] * 3 + [1e-5] * 3)[np.triu_indices(6)])


class Rig:
    """Bridge, link, aircraft and a stand-in for slam whose poses are late and noisy."""

    def __init__(self, seed: int, delay_s: float) -> None:
        T_start = pose(np.eye(3), [0.0, 0.0, 0.1])
        self.px4 = SimulatedPx4(lambda _x, _y: 0.0, T_start, Px4Config(), seed)
        self.camera = FlyingCamera(self.px4)
        self._T_map_world = inverse(pose(np.eye(3), self.camera.pose()[:3, 3]))
        self.now_ns = START_NS
        self.link = InProcessLink(self.px4, Codec(191, 1, lambda: self.now_ns))
        self.bridge = Bridge(AutopilotConfig())
        self.mission = 0
        self.goal: tuple[float, float, float] = (0.0, 0.0, 1.4)
        self.seeing = True
        self._rng, self._delay_s = np.random.default_rng(seed), delay_s
        self._poses: deque[tuple[int, Pose]] = deque()
        self._frames, self._ticks = 0, 0

    def T_map_camera(self) -> Matrix:
        return self._T_map_world @ self.camera.pose()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self._ticks += 1
            self.now_ns = START_NS + round(self._ticks * TICK_S * 1e9)
            self._slam()
            if self._ticks % 12 == 0:
                self.bridge.on_guidance(self._guidance(), self.now_ns)
            for message, received_ns in self.link.poll():
                self.bridge.handle(message, received_ns)
            if self._ticks % 2 == 0:
                for message in self.bridge.tick(self.now_ns):
                    self.link.send(message)
            self.camera.advance(TICK_S)

    def _slam(self) -> None:
        if self._ticks * TICK_S >= self._frames * FRAME_S:
            self._frames += 1
            T = self.T_map_camera().copy()
            T[:3, 3] += 0.005 * self._rng.standard_normal(3)
            seen = Pose(
                stamp_ns=self.now_ns, seq=self._frames, map_id="m", status="tracking", T_map_camera=to_transform(T),
                covariance=COVARIANCE, reset_counter=0, graph_version=0, keyframe_id=None, T_keyframe_camera=None,
                inliers=300, up_sigma_rad=0.01, processing_ms=30.0,
            )  # fmt: skip
            self._poses.append((self.now_ns + round(self._delay_s * 1e9), seen))
        while self._poses and self._poses[0][0] <= self.now_ns:
            _, due = self._poses.popleft()
            if self.seeing:
                self.bridge.on_pose(due, self.now_ns)

    def _guidance(self) -> Guidance:
        setpoint = Setpoint(position_m=self.goal, yaw_rad=0.0, velocity_m_s=(0.0, 0.0, 0.0), yaw_rate_rad_s=0.0)
        return Guidance(
            stamp_ns=self.now_ns, seq=self._ticks, map_id="m", command="toward", magnitude=0.0, unit="m",
            engage=self.mission > 0, land=False, mission_id=self.mission, reset_counter=0, setpoint=setpoint,
        )  # fmt: skip


def airborne(seed: int = 1, delay_s: float = 0.15) -> Rig:
    rig = Rig(seed, delay_s)
    rig.run(3.0)
    rig.mission = 1
    rig.run(12.0)
    assert rig.px4.armed
    assert rig.px4.mode is NavState.OFFBOARD
    return rig


def test_the_bridge_takes_off_and_goes_where_it_is_told() -> None:
    rig = airborne()
    rig.goal = (1.5, -0.5, 1.4)
    rig.run(8.0)
    T = rig.T_map_camera()
    assert np.linalg.norm(T[:3, 3] - rig.goal) < 0.3
    assert abs(math.degrees(camera_yaw(T))) < 6.0


def test_a_pilot_who_takes_the_mode_is_left_alone() -> None:
    rig = airborne(seed=2)
    assert rig.px4.pilot_takes(NavState.POSITION)
    rig.run(0.5)
    rig.goal = (4.0, 0.0, 1.4)
    sent = rig.bridge.setpoints_sent
    rig.run(4.0)
    assert rig.bridge.setpoints_sent == sent
    assert rig.px4.mode is NavState.POSITION
    assert abs(float(rig.T_map_camera()[0, 3])) < 0.5


def test_blind_the_autopilot_comes_down_by_itself() -> None:
    rig = airborne(seed=3)
    rig.seeing = False
    rig.run(14.0)
    assert rig.px4.on_ground
    assert not rig.px4.armed
    assert rig.camera.done
