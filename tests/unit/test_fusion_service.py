"""The fusion service in memory: what it publishes of what it hears; and nothing of it anywhere while it is off."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from schemas.fusion import FusionState
from schemas.slam import Pose, SlamStatus
from schemas.topics import (
    CAMERA_RGBD,
    FUSION_POSE,
    FUSION_STATE,
    SECOND_POSE,
    SECOND_RGBD,
    SIM_SECOND,
    SLAM_KEYFRAME,
    SLAM_POSE,
    VEHICLE_GPS,
    VEHICLE_IMU,
)
from schemas.vehicle import GpsFix, ImuSample, ImuSamples
from services.cli.run_plan import services_for
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.common.geometry import to_transform
from services.common.memory import Hub
from services.fusion import second_camera, second_slam
from services.fusion.config import FusionConfig, SecondCameraConfig
from services.fusion.service import FusionService, build
from services.inventory.geodesy import TangentPlane
from services.navigator.autopilot.config import AutopilotConfig
from tests.examples import frame
from tests.unit.fusion_motion import FRAME_S, located, reading, stamp_ns, true_body

ROOT = Path(__file__).parents[2]
PERIOD_S = 0.008
PLANE = TangentPlane(47.0, 8.0, 400.0)


def config(**fusion: object) -> TreedockConfig:
    values = {"enabled": True, **fusion}
    return TreedockConfig(
        fusion=FusionConfig.model_validate(values), autopilot=AutopilotConfig(camera_offset_m=(0.1, 0.0, 0.02))
    )


class Rig:
    """Fusion on a hub, an aircraft on its known motion."""

    def __init__(self, tree: TreedockConfig) -> None:
        self.hub = Hub(tree, SimulatedClock(stamp_ns(0.0)))
        self.context: Context = self.hub.context("fusion")
        self.service: FusionService = build(self.context)
        self.poses: list[Pose] = []
        self.states: list[FusionState] = []
        world = self.hub.context("evaluate")
        world.on(FUSION_POSE, self.poses.append)
        world.on(FUSION_STATE, self.states.append)
        self.world = world
        self.rng = np.random.default_rng(3)
        self.t_s, self.frames = 0.0, 0

    def run(
        self, seconds: float, status: SlamStatus | None = "tracking", reset: int = 0, map_id: str = "map-1"
    ) -> None:
        """Let time pass; ``status`` None: slam is silent."""
        end_s = self.t_s + seconds
        while self.t_s < end_s:
            self.t_s += PERIOD_S
            self.hub.advance_to(stamp_ns(self.t_s))
            r = reading(self.t_s, PERIOD_S, self.rng)
            sample = ImuSample(stamp_ns=r.stamp_ns, gyro_rad_s=_three(r.gyro_rad_s), accel_m_s2=_three(r.accel_m_s2))
            self.world.publish(VEHICLE_IMU, ImuSamples(stamp_ns=r.stamp_ns, seq=1, samples=(sample,)))
            if self.t_s >= self.frames * FRAME_S:
                if status is not None:
                    self.world.publish(SLAM_POSE, self._pose(self.frames * FRAME_S, status, reset, map_id))
                self.frames += 1
            self.hub.run()

    def _pose(self, t_s: float, status: SlamStatus, reset: int, map_id: str) -> Pose:
        place = located(t_s, self.rng)
        seen = status == "tracking"
        upper = tuple(float(c) for c in place.covariance[np.triu_indices(6)])
        return Pose(
            stamp_ns=place.stamp_ns, seq=self.frames, map_id=map_id, status=status,
            T_map_camera=to_transform(place.T_map_camera) if seen else None, covariance=upper if seen else None,
            reset_counter=reset, graph_version=7, keyframe_id=None, T_keyframe_camera=None, inliers=90,
            up_sigma_rad=0.01, processing_ms=5.0,
        )  # fmt: skip


def _three(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def test_what_slam_locates_goes_through_as_it_is() -> None:
    rig = Rig(config())
    heard: list[Pose] = []
    rig.world.on(SLAM_POSE, heard.append)
    rig.run(2.0, reset=3)
    assert len(rig.poses) == len(heard) == 31
    for told, slams in zip(rig.poses, heard, strict=True):
        assert told == slams.model_copy(update={"seq": told.seq})
    assert [p.seq for p in rig.poses] == list(range(1, 32))


def test_a_lost_slam_is_carried_on_with_a_word_for_it() -> None:
    rig = Rig(config())
    rig.run(3.0, reset=2)
    rig.run(1.6, "lost", reset=2)
    carried = [p for p in rig.poses if p.status == "dead_reckoned"]
    assert 12 <= len(carried) <= 16
    assert all(p.map_id == "map-1" and p.reset_counter == 2 and p.covariance for p in carried)
    last = rig.poses[-1]
    assert last.status == "lost"
    assert last.T_map_camera is None
    assert last.covariance is None
    place = carried[-1].T_map_camera
    assert place is not None
    true = true_body((carried[-1].stamp_ns - stamp_ns(0.0)) * 1e-9)
    assert np.linalg.norm(np.array(place.position_m) - true[:3, 3]) < 0.3
    rig.run(0.5, reset=3)
    assert rig.poses[-1].status == "tracking"
    assert rig.poses[-1].reset_counter == 3


def test_a_silent_slam_is_carried_on_and_then_there_is_silence() -> None:
    rig = Rig(config())
    rig.run(3.0)
    before = len(rig.poses)
    rig.run(2.5, None)
    told = rig.poses[before:]
    assert 8 <= len(told) <= 15
    assert {p.status for p in told} == {"dead_reckoned"}
    stamps = [p.stamp_ns for p in told]
    assert stamps == sorted(set(stamps))
    assert stamps[-1] - stamp_ns(3.0) < 1.1e9


def test_another_map_is_another_map() -> None:
    rig = Rig(config())
    rig.run(2.0)
    rig.run(0.5, "lost")
    rig.run(2.0, map_id="map-2")
    assert rig.poses[-1].map_id == "map-2"
    rig.run(0.4, "lost", map_id="map-2")
    assert rig.poses[-1].status == "dead_reckoned"
    assert rig.poses[-1].map_id == "map-2"


def test_the_state_tells_the_place_on_the_earth_and_what_is_missing() -> None:
    rig = Rig(config(gps=True, gps_noise={"begin_m": 1.5, "slow_m": 0.1, "white_m": 0.05, "delay_s": 0.0}))
    for k in range(60):
        rig.run(0.2)
        p = true_body(rig.t_s)[:3, 3]
        latitude, longitude, altitude = PLANE.to_geodetic(*(float(c) for c in p))
        rig.world.publish(VEHICLE_GPS, GpsFix(
            stamp_ns=stamp_ns(rig.t_s), seq=k, fix="3d" if k % 10 else "none", satellites=12, latitude_deg=latitude,
            longitude_deg=longitude, altitude_m=altitude, horizontal_sigma_m=0.1, vertical_sigma_m=None,
        ))  # fmt: skip
    state = rig.states[-1]
    assert state.gps == "trusted"
    assert state.carrier == "camera"
    assert state.place is not None
    east, north, _ = PLANE.from_geodetic(state.place.latitude_deg, state.place.longitude_deg, state.place.altitude_m)
    assert np.hypot(east - true_body(rig.t_s)[0, 3], north - true_body(rig.t_s)[1, 3]) < 0.4
    forward = true_body(rig.t_s)[:3, 0]
    assert abs(state.place.heading_rad - np.arctan2(forward[0], forward[1])) < 0.15


def test_an_imu_that_does_not_come_is_told() -> None:
    rig = Rig(config())
    rig.hub.advance_to(stamp_ns(4.0))
    rig.hub.run()
    assert "HIGHRES_IMU" in rig.context.health.notes["imu"]


def test_off_by_default_nobody_starts_it_and_nobody_listens_to_it() -> None:
    tree = TreedockConfig()
    assert not tree.fusion.enabled
    assert not {"fusion", "second_camera", "second_slam"} & set(services_for(tree))
    for module in (build, second_camera.build, second_slam.build):
        with pytest.raises(InputError, match=r"fusion\.enabled"):
            module(Hub(tree).context("fusion"))
    two = config(second={"enabled": True})
    assert {"fusion", "second_camera", "second_slam"} <= set(services_for(two))


@pytest.mark.parametrize(
    ("enabled", "topic", "other"), [(False, SLAM_POSE, FUSION_POSE), (True, FUSION_POSE, SLAM_POSE)]
)
def test_navigator_takes_the_one_pose_or_the_other(enabled: bool, topic: object, other: object) -> None:
    from services.navigator.service import build as build_navigator

    hub = Hub(config() if enabled else TreedockConfig())
    build_navigator(hub.context("navigator"))
    world = hub.context("world")
    assert world.listened(topic)  # type: ignore[arg-type]
    assert not world.listened(other)  # type: ignore[arg-type]


def test_nothing_heavy_is_loaded_while_it_is_off() -> None:
    code = (
        "import sys; import services.common.config, services.navigator.service, services.navigator.autopilot.service\n"
        "import services.cli.run_plan; print('gtsam' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_recorder_and_report_pass_over_the_poses_beside_slams() -> None:
    from services.recorder.config import RecorderConfig
    from services.recorder.service import RecorderService

    recorder = RecorderService(Hub(TreedockConfig()).context("recorder"), RecorderConfig(mcap=False))
    rig = Rig(config())
    recorder.take(SLAM_POSE, rig._pose(0.0, "tracking", 0, "map-1"))
    for topic in (SECOND_POSE, FUSION_POSE):
        assert topic.beside
        recorder.take(topic, rig._pose(0.1, "tracking", 0, "another"))
    assert recorder._chronicle._story.map_id == "map-1"


def test_the_second_camera_has_keys_of_its_own() -> None:
    tree = TreedockConfig(fusion=FusionConfig(enabled=True, second=SecondCameraConfig(enabled=True)))
    hub = Hub(tree)
    second_camera.build(hub.context("second_camera"))
    world, first, second = hub.context("world"), list[object](), list[object]()
    world.on(CAMERA_RGBD, first.append)
    world.on(SECOND_RGBD, second.append)
    world.publish(SIM_SECOND, frame(640, 480))
    hub.run()
    assert len(second) == 1
    assert not first


def test_the_second_slam_speaks_on_keys_of_its_own() -> None:
    tree = TreedockConfig(fusion=FusionConfig(enabled=True, second=SecondCameraConfig(enabled=True)))
    hub = Hub(tree)
    second_slam.build(hub.context("second_slam"))
    world, others, poses = hub.context("world"), list[object](), list[Pose]()
    for topic in (SLAM_POSE, SLAM_KEYFRAME):
        world.on(topic, others.append)
    world.on(SECOND_POSE, poses.append)
    world.publish(SECOND_RGBD, frame(640, 480))
    hub.run()
    assert len(poses) == 1
    assert not others
