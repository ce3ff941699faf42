"""``kill -9`` of the live slam over real Zenoh: the next one finds its place in the old map before it gives a pose."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_RGBD, SLAM_POSE
from services.common.bus import Bus
from services.common.geometry import from_transform, inverse, level_camera
from services.common.session import free_port
from tests.process.conftest import ROOT, System, pump, until
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot

F64 = NDArray[np.float64]

PERIOD_S = 1.0 / 15.0
KILL_AT = 45
"""Frames seen before the kill: 3 s."""
DATA = Path(os.environ.get("TREEDOCK_DATA") or ROOT.parent / "shared" / "data")
RECORDING = DATA / "tum_fr1_xyz_15hz"


@dataclass
class Played:
    """Frames with the truth of each, by sequence number, in any frame of reference."""

    frames: list[RgbdFrame]
    truth: dict[int, F64]


@dataclass
class Seen:
    """What slam said."""

    poses: list[Pose] = field(default_factory=list)

    def located(self) -> list[Pose]:
        return [p for p in self.poses if p.T_map_camera is not None]


def room() -> Played:
    """A turn of 60 degrees and back, again and again."""
    there = turn_on_the_spot(KILL_AT, 60.0)
    views = [_view(T) for T in there]
    order = [*range(KILL_AT), *reversed(range(KILL_AT))] * 10
    frames = [replace(views[k], stamp_ns=round((seq + 1) * PERIOD_S * 1e9), seq=seq) for seq, k in enumerate(order)]
    T_map_world = level_camera([0.0, 0.0, 0.0], 0.0) @ inverse(there[0])
    return Played(frames, {seq: T_map_world @ there[k] for seq, k in enumerate(order)})


def _view(T_world_camera: F64) -> RgbdFrame:
    grey, depth_m = look(T_world_camera)
    raw = np.round(depth_m * INTRINSICS.depth_scale).astype(np.uint16)
    return RgbdFrame(
        stamp_ns=1, seq=0, intrinsics=INTRINSICS, depth=raw.tobytes(),
        colour=np.repeat(grey[:, :, None], 3, axis=2).tobytes(), accel_camera=(0.0, -9.81, 0.0),
    )  # fmt: skip


def recorded() -> Played:
    """The desk, seen by a moving Kinect; truth by motion capture."""
    from services.camera.config import CameraConfig
    from services.camera.sources import open_recording
    from services.evaluate.ate import read_trajectory

    truth = read_trajectory(RECORDING / "groundtruth.txt")
    frames, places = [], {}
    for item in open_recording(RECORDING, CameraConfig()):
        if isinstance(item, RgbdFrame):
            nearest = int(np.argmin(np.abs(truth.stamps_ns - item.stamp_ns)))
            frames.append(item)
            places[item.seq] = truth.poses[nearest]
    return Played(frames, places)


def slam_process(system: System) -> subprocess.Popen[bytes]:
    config = system.folder / "config.json"
    config.write_text(json.dumps({"slam": {"map_folder": str(system.folder / "map")}}))
    command = [sys.executable, "-m", "services.cli.app", "slam", "--config", str(config), "--port", str(system.port)]
    with system.log("slam").open("ab") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    system.processes.append(process)
    return process


def play(bus: Bus, frames: Iterator[RgbdFrame], seconds: float) -> None:
    """Send frames in real time, and take what comes."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        due_s = time.monotonic() + PERIOD_S
        frame = next(frames, None)
        if frame is not None:
            bus.publish(CAMERA_RGBD, frame)
        while time.monotonic() < due_s:
            pump(bus)
            time.sleep(0.003)


def aligned(poses: list[Pose], truth: dict[int, F64]) -> F64:
    """Return the rigid transform (4, 4) that lays the truth on the poses: the mean of what each says, turned to a rotation."""
    each = np.mean([from_transform(p.T_map_camera) @ inverse(truth[p.seq]) for p in poses if p.T_map_camera], axis=0)
    U, _, Vt = np.linalg.svd(each[:3, :3])
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    centre = np.mean([truth[p.seq][:3, 3] for p in poses], axis=0)
    ours = np.mean([from_transform(p.T_map_camera)[:3, 3] for p in poses if p.T_map_camera], axis=0)
    T[:3, 3] = ours - T[:3, :3] @ centre
    return T


@pytest.fixture
def system(tmp_path: Path) -> Iterator[System]:
    system = System(free_port(), tmp_path)
    try:
        yield system
    finally:
        system.kill_all()


@pytest.mark.slow
@pytest.mark.parametrize("source", ["room", "recording"])
def test_slam_killed_goes_on_in_its_old_map(system: System, source: str) -> None:
    if source == "recording" and not RECORDING.is_dir():
        pytest.skip(f"{RECORDING} is absent: set TREEDOCK_DATA")
    played = room() if source == "room" else recorded()
    system.start("router")
    slam = slam_process(system)
    seen = Seen()
    with system.bus() as bus:
        bus.subscribe(SLAM_POSE, seen.poses.append)
        frames = iter(played.frames)
        first = next(frames)

        def knock() -> bool:  # until slam is there
            bus.publish(CAMERA_RGBD, first)
            return bool(seen.poses)

        assert until(knock, 120.0, bus), system.said("slam")
        play(bus, frames, KILL_AT * PERIOD_S)
        slam.send_signal(signal.SIGKILL)
        slam.wait()
        until(lambda: False, 0.5, bus)  # its last words arrive
        before = seen.located()
        assert len(before) > 0.5 * KILL_AT
        slam_process(system)
        seen.poses.clear()
        for _ in range(160):  # a busy machine starts a process in many seconds
            play(bus, frames, 0.25)
            if len(seen.located()) >= 15:
                break
    after = seen.located()
    assert len(after) >= 15, system.said("slam")
    assert {p.map_id for p in (*before, *seen.poses)} == {before[0].map_id}
    waited = seen.poses[: seen.poses.index(after[0])]
    assert all(p.status == "relocalising" for p in waited)
    assert after[0].reset_counter != before[-1].reset_counter
    assert after[0].graph_version > before[-1].graph_version
    T_map_truth = np.eye(4) if source == "room" else aligned(before[-15:], played.truth)
    for pose in after:
        assert pose.T_map_camera is not None
        true = T_map_truth @ played.truth[pose.seq]
        assert np.linalg.norm(from_transform(pose.T_map_camera)[:3, 3] - true[:3, 3]) < 0.05
