"""slam's service on the in-memory bus: order of messages, bad frames, the message's fields."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.camera import Intrinsics, RgbdFrame
from schemas.codec import Wire, decode, encode
from schemas.slam import Graph, Keyframe, Pose
from schemas.topics import CAMERA_RGBD, SLAM_GRAPH, SLAM_KEYFRAME, SLAM_POSE, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.camera.codecs import decode_depth
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.geometry import from_transform
from services.common.memory import Hub, MemoryContext
from services.navigator.autopilot.config import AutopilotConfig
from services.slam.config import SlamConfig
from services.slam.service import build
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot


def frame(seq: int, intrinsics: Intrinsics = INTRINSICS) -> RgbdFrame:
    grey, depth_m = look(turn_on_the_spot(12, 30.0)[min(seq, 11)])
    raw = np.round(depth_m * intrinsics.depth_scale).astype(np.uint16)
    return RgbdFrame(
        stamp_ns=seq * 66_666_667, seq=seq, intrinsics=intrinsics, depth=raw.tobytes(),
        colour=np.repeat(grey[:, :, None], 3, axis=2).tobytes(), accel_camera=(0.0, -9.81, 0.0),
    )  # fmt: skip


def started(
    autopilot: AutopilotConfig = AutopilotConfig(),  # noqa: B008
) -> tuple[Hub, MemoryContext, MemoryContext, list[Wire]]:
    hub = Hub(TreedockConfig(autopilot=autopilot), SimulatedClock())
    context = hub.context("slam")
    build(context)  # the protocol's clock is writable, so it wants exactly Clock
    said: list[Wire] = []
    camera = hub.context("camera")
    for topic in (SLAM_POSE, SLAM_KEYFRAME, SLAM_GRAPH):
        camera.on(topic, said.append)
    return hub, context, camera, said


def test_keyframe_and_graph_come_before_the_pose_that_rests_on_them() -> None:
    hub, _, camera, said = started()
    camera.publish(CAMERA_RGBD, frame(0))
    hub.run()
    assert [type(m) for m in said] == [Keyframe, Graph, Pose]
    assert all(decode(type(m), encode(m)) == m for m in said)
    keyframe, pose = said[0], said[-1]
    assert isinstance(keyframe, Keyframe)
    assert isinstance(pose, Pose)
    assert pose.keyframe_id == keyframe.keyframe_id
    raw = decode_depth(keyframe.depth, "zstd", INTRINSICS.width, INTRINSICS.height)
    assert raw.tobytes() == bytes(frame(0).depth)


@pytest.mark.parametrize(("pitch_rad", "yaw_rad"), [(0.0, 0.0), (0.35, 0.0), (0.1, 0.7)])
def test_the_autopilots_level_is_turned_by_the_cameras_mount(pitch_rad: float, yaw_rad: float) -> None:
    """The aircraft stands level: a camera that looks down on it by 20 degrees looks down in the map too."""
    hub, _, camera, said = started(AutopilotConfig(camera_pitch_rad=pitch_rad, camera_yaw_rad=yaw_rad))
    hub.context("autopilot").publish(VEHICLE_STATE, VehicleState(
        stamp_ns=0, seq=0, connected=True, armed=False, mode="hold", landed="on_ground",
        quaternion_map_body=(0.0, 0.0, 0.0, 1.0), position_map_m=None, velocity_map_m_s=None, battery_share=None,
        vision_fused=False, operator_override=False, engaged_mission_id=0, link_age_s=0.0,
    ))  # fmt: skip
    camera.publish(CAMERA_RGBD, replace(frame(0), accel_camera=None))
    hub.run()
    pose = said[-1]
    assert isinstance(pose, Pose)
    assert pose.T_map_camera is not None
    forward = from_transform(pose.T_map_camera)[:3, 2]
    right = from_transform(pose.T_map_camera)[:3, 0]
    assert np.arcsin(-forward[2]) == pytest.approx(pitch_rad, abs=1e-6)
    assert right[2] == pytest.approx(0.0, abs=1e-6)


def test_every_frame_has_a_pose_and_silence_polishes_the_map() -> None:
    hub, _, camera, said = started()
    for seq in range(6):
        hub.advance_to(seq * 66_666_667)
        camera.publish(CAMERA_RGBD, frame(seq))
        hub.run()
    poses = [m for m in said if isinstance(m, Pose)]
    assert [p.seq for p in poses] == list(range(6))
    assert all(p.T_map_camera is not None and p.covariance is not None for p in poses)
    camera.publish(CAMERA_RGBD, frame(11))
    hub.run()
    hub.advance_to(5_000_000_000)
    graphs = [m for m in said if isinstance(m, Graph)]
    assert [g.version for g in graphs] == sorted({g.version for g in graphs})


def test_another_cameras_frame_is_dropped_counted_and_told() -> None:
    hub, context, camera, said = started()
    camera.publish(CAMERA_RGBD, frame(0))
    hub.run()
    before = len(said)
    camera.publish(CAMERA_RGBD, frame(1, INTRINSICS.model_copy(update={"fx": 300.0})))
    hub.run()
    assert len(said) == before
    assert context.health.counters["dropped_bad_frames"] == 1
    assert "fx 300" in context.health.notes["camera/rgbd"]
    camera.publish(CAMERA_RGBD, frame(2))
    hub.run()
    assert isinstance(said[-1], Pose)
    assert not context.health.notes


def test_a_frame_from_the_past_is_dropped() -> None:
    hub, context, camera, said = started()
    for seq in (3, 2):
        camera.publish(CAMERA_RGBD, frame(seq))
        hub.run()
    assert sum(isinstance(m, Pose) for m in said) == 1
    assert context.health.counters["dropped_bad_frames"] == 1


class RealTime(MemoryContext):
    """As over Zenoh: nothing waits for what a message causes."""

    lockstep = False


def live(folder: Path) -> tuple[Hub, RealTime, list[Wire]]:
    hub = Hub(TreedockConfig(slam=SlamConfig(map_folder=folder)), SimulatedClock())
    context = RealTime(hub, "slam")
    build(context)
    said: list[Wire] = []
    for topic in (SLAM_POSE, SLAM_KEYFRAME, SLAM_GRAPH):
        hub.context("camera").on(topic, said.append)
    return hub, context, said


def test_live_the_pose_waits_for_nothing_and_mapping_is_told_though_no_frame_comes(tmp_path: Path) -> None:
    hub, context, said = live(tmp_path)
    for seq in range(0, 12, 3):
        hub.context("camera").publish(CAMERA_RGBD, frame(seq))
        hub.run()
    assert isinstance(said[0], Pose)
    versions = [m.version for m in said if isinstance(m, Graph)]
    end_s = time.monotonic() + 20.0
    while not any(isinstance(m, Graph) and m.reason == "full_ba" for m in said) and time.monotonic() < end_s:
        hub.advance_to(hub.clock.now_ns() + 500_000_000)
        hub.run()
        time.sleep(0.01)
    told = [m for m in said if isinstance(m, Graph)]
    assert told[-1].reason == "full_ba"
    assert [m.version for m in told] == sorted({m.version for m in told})
    assert len(told) > len(versions)
    hub.stop()
    assert context.health.counters["maps_begun"] == 1
    assert not list(tmp_path.iterdir()), "a slam that was stopped leaves no map"


def test_live_a_second_slam_goes_on_in_the_map_of_a_killed_one(tmp_path: Path) -> None:
    hub, _, said = live(tmp_path)
    for seq in range(0, 12, 3):
        hub.context("camera").publish(CAMERA_RGBD, frame(seq))
        hub.run()
    first = [m for m in said if isinstance(m, Pose)]
    assert wait_for(lambda: (tmp_path / "map.npz").exists())
    again, context, said = live(tmp_path)
    again.context("camera").publish(CAMERA_RGBD, replace(frame(20), colour=bytes(320 * 240 * 3)))
    again.context("camera").publish(CAMERA_RGBD, frame(21))
    again.run()
    second = [m for m in said if isinstance(m, Pose)]
    assert [p.status for p in second] == ["relocalising", "tracking"]
    assert {p.map_id for p in (*first, *second)} == {first[0].map_id}
    assert second[-1].reset_counter != first[-1].reset_counter
    assert context.health.counters["maps_taken_up"] == 1
    graphs = [m for m in said if isinstance(m, Graph)]
    assert [g.reason for g in graphs][:1] == ["restored"]


def wait_for(condition: Callable[[], bool]) -> bool:
    end_s = time.monotonic() + 20.0
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.01)
    return condition()
