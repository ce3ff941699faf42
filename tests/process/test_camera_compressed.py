"""The camera on one machine, slam on another: two addresses, two routers' worth of nothing in common but the network."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.camera import Intrinsics, RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SLAM_POSE
from services.camera.codecs import decode_depth_raw
from services.camera.sources.mcap_file import FrameWriter
from services.common.bus import Bus
from services.common.context import HealthBook
from services.common.session import free_port, opened_client
from tests.process.conftest import ROOT, HealthWatch, until

FRAMES = 45
CAMERA = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
AIRCRAFT, GROUND = "127.0.0.1", "127.0.0.2"
"""The router listens on every address of the aircraft; the ground's nodes come in by another one."""


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[bytes]]]:
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()


def recording(path: Path) -> Path:
    """Write a textured wall that moves past."""
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 255, (60, 120, 3), dtype=np.uint8), (640, 240), interpolation=cv2.INTER_CUBIC)
    depth = np.full((240, 320), 2000, np.uint16).tobytes()
    with FrameWriter(path) as writer:
        for k in range(FRAMES):
            colour = np.ascontiguousarray(wall[:, 2 * k : 2 * k + 320]).tobytes()
            writer.add(RgbdFrame(10**9 + k * 100_000_000, k, CAMERA, colour, depth))
    return path


def test_slam_on_another_machine_takes_the_compressed_frames(
    tmp_path: Path, processes: list[subprocess.Popen[bytes]]
) -> None:
    port = free_port()

    def start(name: str, host: str, *settings: str) -> None:
        arguments = [sys.executable, "-m", "services.cli.app", name, "--port", str(port)]
        for setting in (f"router.host={host}", *settings):
            arguments += ["--set", setting]
        with (tmp_path / f"{name}.log").open("wb") as log:
            processes.append(subprocess.Popen(arguments, cwd=ROOT, stdout=log, stderr=log))

    start("router", "0.0.0.0")
    with opened_client(f"tcp/{GROUND}:{port}", lambda: False, wait_s=20.0) as session:
        bus = Bus(session, "uav1", HealthBook())
        health = HealthWatch(bus)
        poses: list[Pose] = []
        packed: list[RgbdFrame] = []
        bus.subscribe(SLAM_POSE, poses.append)
        bus.subscribe(CAMERA_COMPRESSED, packed.append)
        start("slam", GROUND, "slam.frames=compressed")
        assert until(lambda: health.state("slam") in ("ready", "degraded"), 90.0, bus), (
            tmp_path / "slam.log"
        ).read_text()
        start("camera", AIRCRAFT, f"camera.source=mcap:{recording(tmp_path / 'a.mcap')}")
        assert until(lambda: health.counter("camera", "source_done") == 1, 60.0, bus), (
            tmp_path / "camera.log"
        ).read_text()
        assert until(lambda: len(poses) > FRAMES // 2 and health.counter("slam", "frames") >= len(poses), 20.0, bus)
    tracked = [pose for pose in poses if pose.status == "tracking"]
    assert len(tracked) > FRAMES // 2, f"{len(poses)} poses, {len(tracked)} tracked"
    assert health.latest["slam"].rates_hz.get(CAMERA_RGBD.name, 0.0) == 0.0, "nothing raw crossed"
    assert (packed[0].colour_encoding, packed[0].depth_encoding) == ("jpeg", "zstd")
    assert set(np.unique(decode_depth_raw(packed[0]))) == {2000}
    assert max(len(frame.to_bytes()) for frame in packed) < 60_000, "a raw frame of this size has 384,000 bytes"
