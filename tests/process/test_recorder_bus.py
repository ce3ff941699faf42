"""Recorder and replay over real Zenoh: what is recorded is what was said, and it can be said again."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from schemas.camera import RgbdFrame
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, TREES_LIST, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.camera.codecs import recode
from services.common.bus import Bus
from services.recorder.reader import Recorded, messages
from tests.process.conftest import ROOT, System
from tests.process.nodes import frame, tree_list
from tests.unit.recorder_files import recorded


def treedock(system: System, *arguments: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "services.cli.app", *arguments, "--port", str(system.port)]
    with system.log(arguments[0]).open("ab") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    system.processes.append(process)
    return process


def waited_for(bus: Bus, service: str) -> None:
    deadline = time.monotonic() + 20.0
    while service not in bus.live_services():
        assert time.monotonic() < deadline, f"{service} did not come up"
        time.sleep(0.05)


def test_a_run_is_recorded_and_fed_back(system: System, tmp_path: Path) -> None:
    system.start("router")
    with system.bus() as bus:
        recorder = treedock(system, "record", "--out", str(tmp_path / "rec"))
        waited_for(bus, "recorder")
        deadline = time.monotonic() + 5.0
        while not bus.listened(CAMERA_COMPRESSED):
            assert time.monotonic() < deadline, "the recorder does not ask for frames"
            time.sleep(0.05)
        bus.publish(TREES_LIST, tree_list(1))
        for number in range(20):
            bus.publish(CAMERA_COMPRESSED, recode(frame(number), "jpeg", "zstd"))
            time.sleep(0.05)
        time.sleep(0.3)
        recorder.terminate()
        assert recorder.wait(timeout=10.0) == 0
        path = next((tmp_path / "rec").glob("*.mcap"))
        found = [entry for entry in messages(path) if isinstance(entry, Recorded)]
        recorded = [e.message.seq for e in found if isinstance(e.message, RgbdFrame)]
        # the bus drops frames rather than wait, which a busy machine makes it do; the recorder itself drops none
        assert len(recorded) >= 8
        assert recorded == sorted(set(recorded))
        assert [e.message for e in found if e.topic is TREES_LIST] == [tree_list(1)]
        assert any(e.topic.name == "health/*" and e.leaf == "recorder" for e in found)

        heard: list[RgbdFrame] = []
        bus.subscribe(CAMERA_RGBD, heard.append)
        time.sleep(0.3)
        player = treedock(system, "replay", str(path))
        deadline = time.monotonic() + 20.0
        while player.poll() is None and time.monotonic() < deadline:
            bus.inbox.wait(0.1)
            if (taken := bus.inbox.take()) is not None:
                taken[0].handler(taken[1])
        assert player.wait(timeout=10.0) == 0
    replayed = [f.seq for f in heard]
    assert len(replayed) >= 3
    assert replayed == sorted(set(replayed) & set(recorded))
    assert heard[0].colour_encoding == "bgr8"
    assert all(abs(time.time_ns() - f.stamp_ns) < 60e9 for f in heard), "stamps are of now"
    assert f"{len(recorded)} messages" in system.said("replay")


def test_a_recorded_flight_is_not_said_again_beside_what_flies(system: System, tmp_path: Path) -> None:
    """Its guidance comes with fresh stamps: a bridge that stands disarmed would engage."""
    path = recorded(tmp_path)
    system.start("router")
    with system.bus() as bus:
        heard: list[VehicleState] = []
        bus.subscribe(VEHICLE_STATE, heard.append)
        bus.declare_live("autopilot")
        for arguments in ([], ["--everything"]):
            player = treedock(system, "replay", str(path), *arguments)
            assert player.wait(timeout=20.0) == 2
        assert bus.inbox.take() is None
    assert system.said("replay").count("replay: autopilot of ") == 2
    with system.bus() as bus:
        bus.declare_live("station")
        assert treedock(system, "replay", str(path), "--everything").wait(timeout=20.0) == 0
