"""``treedock run``: the real services over a short recording, a killed one among them, and runs that cannot begin."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.process.conftest import ROOT, until

FRAMES = 60
INTRINSICS = {"width": 320, "height": 240, "fx": 250.0, "fy": 250.0, "cx": 159.5, "cy": 119.5, "depth_scale": 1000.0}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A textured wall, four seconds of it: enough for poses and a map, without any tree."""
    import cv2

    folder = tmp_path_factory.mktemp("wall")
    (folder / "camera.json").write_text(json.dumps(INTRINSICS))
    for name in ("rgb", "depth"):
        (folder / name).mkdir()
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 255, (60, 120, 3), dtype=np.uint8), (640, 240), interpolation=cv2.INTER_CUBIC)
    depth = np.full((240, 320), 2000, dtype=np.uint16)
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for i in range(FRAMES):
        stamp = f"{100.0 + i / 15.0:.6f}"
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), wall[:, 2 * i : 2 * i + 320])
        cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), depth)
        for name in lists:
            lists[name].append(f"{stamp} {name}/{stamp}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "services.cli.app", "run", *arguments],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def ended(process: subprocess.Popen[str], timeout_s: float = 120.0) -> tuple[int, str, str]:
    try:
        out, err = process.communicate(timeout=timeout_s)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=10)
    return process.returncode, out, err


def services_of(process: subprocess.Popen[str]) -> dict[str, int]:
    """Return pids by service name."""
    try:
        children = psutil.Process(process.pid).children()
        return {child.cmdline()[3]: child.pid for child in children if len(child.cmdline()) > 3}
    except psutil.Error:
        return {}


@pytest.mark.slow  # the services compile their kernels when the cache is cold
def test_a_recording_runs_to_its_end_although_a_service_was_killed(recording: Path, tmp_path: Path) -> None:
    begin_s = time.monotonic()
    process = start("--source", f"tum:{recording}", "--json", "--logs", str(tmp_path / "logs"))
    assert until(lambda: "camera" in services_of(process), timeout_s=240.0), "the camera starts when the rest is ready"
    pids = services_of(process)
    os.kill(pids["mapper"], signal.SIGKILL)
    code, out, err = ended(process, 240.0)
    assert code == 0, err
    values = json.loads(out)
    assert values["restarts"] == {"mapper": 1}
    assert values["frames"] == FRAMES
    assert values["trees"] == []
    assert set(values["services"]) == {
        "router",
        "station",
        "preview",
        "camera",
        "slam",
        "mapper",
        "detector",
        "refiner",
    }
    assert values["duration_s"] <= time.monotonic() - begin_s
    assert not any(psutil.pid_exists(pid) and "services" in str(psutil.Process(pid).cmdline()) for pid in pids.values())


def test_ctrl_c_stops_everything_within_three_seconds(recording: Path, tmp_path: Path) -> None:
    process = start("--source", f"tum:{recording}", "--logs", str(tmp_path / "logs"))
    assert until(lambda: {"slam", "refiner"} <= set(services_of(process)), timeout_s=30.0)
    pids = services_of(process)
    time.sleep(0.5)
    begin_s = time.monotonic()
    process.send_signal(signal.SIGINT)
    code, _, err = ended(process, 20.0)
    assert time.monotonic() - begin_s < 5.0, "three on an idle machine"
    assert code == 130, err
    assert "Traceback" not in err
    assert not any(psutil.pid_exists(pid) for pid in pids.values())


def test_a_source_that_is_not_there_ends_the_run_with_one_line(tmp_path: Path) -> None:
    code, out, err = ended(start("--source", f"tum:{tmp_path / 'nowhere'}", "--logs", str(tmp_path / "logs")))
    assert code == 2
    assert out == ""
    last = err.strip().splitlines()[-1]
    assert re.match(r"^treedock: .*nowhere", last), err
    assert "Traceback" not in err


def test_a_port_that_was_asked_for_and_is_taken_is_told() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, _, err = ended(start("--port", str(port)))
    assert code == 2
    assert (
        err == f"treedock: port {port} on 127.0.0.1 is in use: stop what listens there, or choose another with --port\n"
    )


def test_two_aircraft_have_one_router_and_station_and_all_end_together(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    process = start("--aircraft", "2", "--seed", "2", "--logs", str(logs), "--set", "simulator.small=true", "--json")
    folders = [logs / uav for uav in ("uav1", "uav2")]
    assert until(lambda: all((folder / "camera.log").exists() for folder in folders), timeout_s=120.0)
    below = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    code, out, err = ended(process, 60.0)
    assert code == 130, err
    assert "Traceback" not in err
    assert json.loads(out)["aircraft"]["uav2"]["docks"] == []
    assert (logs / "router.log").exists()
    assert not any((folder / "router.log").exists() or (folder / "station.log").exists() for folder in folders)
    assert until(lambda: not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in below), timeout_s=30.0)
