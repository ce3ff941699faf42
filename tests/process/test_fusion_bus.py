"""Fusion over the bus as a process of its own: off it does not start, on it publishes fused poses."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np

from schemas.slam import Pose
from schemas.topics import FUSION_POSE, SLAM_POSE, VEHICLE_IMU
from schemas.vehicle import ImuSample, ImuSamples
from services.common.bus import Bus
from services.common.geometry import level_camera, to_transform
from tests.process.conftest import ROOT, System, pump, until

PERIOD_NS = 10_000_000
UPPER = tuple(float(c) for c in np.diag(np.repeat([1e-5, 1e-6], 3))[np.triu_indices(6)])


def start(system: System, *settings: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "services.cli.app", "fusion", "--port", str(system.port)]
    for setting in settings:
        command += ["--set", setting]
    with system.log("fusion").open("ab") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    system.processes.append(process)
    return process


class Imu:
    """An IMU at rest whose samples have no gap, however busy the machine is."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._last_ns = time.time_ns()

    def send(self) -> None:
        """Send what has come since the last call."""
        stamps = range(self._last_ns + PERIOD_NS, time.time_ns(), PERIOD_NS)
        for begin in range(0, len(stamps), 100):
            samples = tuple(
                ImuSample(stamp_ns=stamp, gyro_rad_s=(0.0, 0.0, 0.0), accel_m_s2=(0.0, 0.0, 9.80665))
                for stamp in stamps[begin : begin + 100]
            )
            self._last_ns = samples[-1].stamp_ns
            self._bus.publish(VEHICLE_IMU, ImuSamples(stamp_ns=self._last_ns, seq=1, samples=samples))


def pose(bus: Bus, *, seen: bool) -> None:
    T = to_transform(level_camera((0.0, 0.0, 1.0), 0.0))
    bus.publish(SLAM_POSE, Pose(
        stamp_ns=time.time_ns() - 30_000_000, seq=1, map_id="map-1", status="tracking" if seen else "lost",
        T_map_camera=T if seen else None, covariance=UPPER if seen else None, reset_counter=0, graph_version=0,
        keyframe_id=None, T_keyframe_camera=None, inliers=100, up_sigma_rad=0.01, processing_ms=5.0,
    ))  # fmt: skip


def test_switched_off_it_says_so_and_ends(routed: System) -> None:
    process = start(routed)
    assert process.wait(timeout=60) == 2
    assert "fusion.enabled=true" in routed.said("fusion")


def test_switched_on_it_publishes_slams_pose_and_carries_it_on(routed: System) -> None:
    process = start(routed, "fusion.enabled=true")
    with routed.bus() as bus:
        told: list[Pose] = []
        bus.subscribe(FUSION_POSE, told.append)

        imu = Imu(bus)

        def fed(*, seen: bool, wanted: str) -> bool:
            imu.send()
            pose(bus, seen=seen)
            end_s = time.monotonic() + 0.05
            while time.monotonic() < end_s:
                pump(bus)
                time.sleep(0.005)
            return any(p.status == wanted for p in told)

        assert until(lambda: fed(seen=True, wanted="tracking"), timeout_s=60.0), routed.said("fusion")
        for _ in range(20):
            fed(seen=True, wanted="tracking")
        wanted = "dead_reckoned"
        assert until(lambda: fed(seen=True, wanted=wanted) or fed(seen=False, wanted=wanted), timeout_s=30.0)
    carried = [p for p in told if p.status == "dead_reckoned"]
    assert all(p.T_map_camera is not None and p.covariance is not None for p in carried)
    assert process.poll() is None
