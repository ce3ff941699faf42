"""Rows of what happens around the processes: noise on the wire, a slow listener, a full disk, damaged files, a set clock."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mav

from services.common.config import TreedockConfig
from services.evaluate.faults.bench_rig import Bench
from services.evaluate.faults.flown import ENDED
from services.evaluate.faults.killing import passing
from services.evaluate.faults.missions import NEVER_S, Back, Flights
from services.evaluate.faults.model import Result, Row
from services.evaluate.faults.rig import FUSED, ONBOARD, Rig
from services.evaluate.faults.system import flight_config
from services.evaluate.faults.verdict import held_late

_STALL_S = 0.7
"""Longer than the 0.4 s after which a silent slam is held for, shorter than the 1.2 s after which is landed."""
_STALL_MOST_S = 0.9
"""On a busy machine the end of a stall comes late; a longer one lands, rightly."""
_NOISE_HZ = 200.0
_FLIGHT_WITHIN_S = 300.0
_TMPFS_MB = 3
_EMPTY_MOST = 3
_AS_OFTEN = 0.7
"""Of the poses a second (of the wall) without it: one mission differs from the next by a fifth."""


def rows() -> list[Row]:
    """Return the rows."""
    return [
        Row("camera stall", "flight", "the camera sends nothing for 0.7 s (simulated), three times",
            "hold within 0.5 s, then the mission goes on", _camera_stall),
        Row("MAVLink noise", "flight", "200 datagrams a second of noise, torn and damaged messages at the bridge's port for a whole mission",
            "the mission docks and never holds; the noise is counted in health", _noise),
        Row("slow consumer", "flight", "a subscriber of all of the aircraft's keys that takes a second for each sample, for a whole mission",
            "the mission docks; poses come as often as without it; no process grows by more than 50 MB", _slow_consumer),
        Row("disk full", "machine", f"the recorder's disk has {_TMPFS_MB} MB: it is full within seconds of the mission",
            "the mission docks; the recorder lives on and says so; what it wrote can be read", _disk_full),
        Row("corrupt config", "machine", "each service is started on a configuration that is cut short, has an unknown key or a wrong value",
            "it ends with exit code 2 within 10 s, in one line that names the file", _corrupt_config),
        Row("config corrupted in flight", "flight", "the recorder's configuration is overwritten with noise, and the recorder killed",
            "the mission flies on; the recorder is tried again, and back when the file is", _config_in_flight),
    ]  # fmt: skip


def _camera_stall(bench: Bench) -> Result:
    again, stalls = list[str](), list[float]()

    def stall(flights: Flights) -> Back:
        rig = flights.rig
        restarts, at_ns = rig.supervisor.restarts, rig.flown.now_ns
        pid, _ = rig.harm("camera", signal.SIGSTOP)
        rig.fly_s(_STALL_S, 20.0)
        with contextlib.suppress(ProcessLookupError):  # taken for hung: told by the restart
            os.kill(pid, signal.SIGCONT)
        stalls.append((rig.flown.now_ns - at_ns) * 1e-9)
        rig.fly_s(1.0, 20.0)
        again.extend([f"{rig.supervisor.restarts - restarts} restarts"] * (rig.supervisor.restarts > restarts))
        return Back()

    result = passing(bench, "camera stall", stall, lands=False, also=held_late)
    measured = {**result.measured, "stall_s": max(stalls)}
    if max(stalls) > _STALL_MOST_S:
        return Result((), measured, result.told, f"the machine is too busy: one stall became {max(stalls):.1f} s long")
    return Result((*result.failed, *again), measured, result.told)


def _whole_mission(flights: Flights) -> list[str]:
    """Fly from start to landing; return what was wrong with it."""
    flown = flights.rig.flown
    flights.land()
    flights.begin()
    begun_ns, docks = flown.now_ns, flown.docks
    ended = flights.rig.until(lambda: flown.state in ENDED and not flown.armed, _FLIGHT_WITHIN_S)
    failed = [] if ended else [f"the mission did not end: {flown.state}, {flown.reason()}"]
    failed += [] if flown.docks > docks else [f"not docked: {flown.state}, {flown.reason()}"]
    holds = dict.fromkeys(s.reason for s in flown.states if s.since_ns >= begun_ns and s.state == "hold")
    return failed + [f"held: {reason}" for reason in holds] + [f"{flown.touches} touches"] * bool(flown.touches)


@contextmanager
def _noise_at(port: int, rng: np.random.Generator) -> Iterator[list[int]]:
    """Send noise to a UDP port of this machine until the end; yields a list whose length is what was sent."""
    heartbeat = bytes(mav.MAVLink(None, srcSystem=1).heartbeat_encode(2, 12, 0, 0, 4).pack(mav.MAVLink(None)))
    stop, sent = threading.Event(), list[int]()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not stop.wait(1.0 / _NOISE_HZ):
                data = bytearray(heartbeat)
                data[int(rng.integers(1, len(data)))] ^= int(rng.integers(1, 256))
                torn = heartbeat[: int(rng.integers(1, len(heartbeat)))]
                noise = b"\xfd" + rng.bytes(int(rng.integers(1, 300)))
                out.sendto((bytes(data), torn, noise, rng.bytes(40))[len(sent) % 4], ("127.0.0.1", port))
                sent.append(1)

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    try:
        yield sent
    finally:
        stop.set()
        thread.join()


def _noise(bench: Bench) -> Result:
    flights = bench.flights("MAVLink noise")
    rig = flights.rig
    before = rig.health["autopilot"].counters.get("mavlink_bad", 0)
    port = int(rig.config.autopilot.connection.rpartition(":")[2])
    with _noise_at(port, bench.rng("noise")) as sent:
        failed = _whole_mission(flights)
    rig.pump(2.5)
    counted = rig.health["autopilot"].counters.get("mavlink_bad", 0) - before
    failed += [] if counted > 0.5 * len(sent) else [f"{counted} of {len(sent)} counted"]
    return Result(tuple(failed), {"datagrams": float(len(sent)), "counted": float(counted)}, ("one mission",))


_SLOW = """
import sys, time, zenoh
from services.common.session import client_config, opened
with opened(client_config(sys.argv[1])) as session:
    session.declare_subscriber("treedock/**", lambda sample: time.sleep(1.0))
    print("up", flush=True)
    time.sleep(1e6)
"""


def _slow_consumer(bench: Bench) -> Result:
    flights = bench.flights("slow consumer")
    rig = flights.rig
    failed, without_hz = _paced_mission(flights)
    memory = _memory_mb(rig)
    slow = subprocess.Popen(
        [sys.executable, "-c", _SLOW, rig.config.router.endpoint], stdout=subprocess.PIPE, text=True
    )
    try:
        assert slow.stdout is not None
        slow.stdout.readline()
        words, with_hz = _paced_mission(flights)
        failed += words
        grown = {name: mb - memory[name] for name, mb in _memory_mb(rig).items()}
    finally:
        slow.kill()
        slow.communicate()
    failed += [] if with_hz > _AS_OFTEN * without_hz else [f"poses at {with_hz:.1f} Hz, {without_hz:.1f} without it"]
    failed += [f"{name} grew by {mb:.0f} MB" for name, mb in grown.items() if mb > 50.0]
    return Result(
        tuple(failed),
        {"pose_hz": with_hz, "pose_hz_without": without_hz, "grown_mb": max(grown.values())},
        ("two missions",),
    )


def _paced_mission(flights: Flights) -> tuple[list[str], float]:
    """Fly a whole mission; return what was wrong with it, and its poses per second of the wall: simulated time waits for slam."""
    flights.land()
    poses, begin_s = flights.rig.flown.poses, time.monotonic()
    failed = _whole_mission(flights)
    return failed, (flights.rig.flown.poses - poses) / (time.monotonic() - begin_s)


def _memory_mb(rig: Rig) -> dict[str, float]:
    import psutil

    return {name: psutil.Process(rig.pid(name)).memory_info().rss / 2**20 for name in rig.services}


def _disk_full(bench: Bench) -> Result:
    from services.evaluate.faults.hosts import enter_fresh, why_not

    if reason := why_not():
        return Result(skipped=reason)
    bench.close()  # two systems at once would be slow
    folder = bench.fresh()
    disk = folder / "recordings"
    disk.mkdir()
    mounted = f'mount -t tmpfs -o size={_TMPFS_MB}m tmpfs {disk} && exec "$@"'
    prefix = [word for word in enter_fresh()[:-1] if word != "--net"]
    with Rig(
        flight_config(bench.seed, folder), folder, (*ONBOARD, "simulator"),
        prefix=lambda name: [*prefix, "--", "sh", "-c", mounted, "sh"] if name == "recorder" else [],
    ) as rig:  # fmt: skip
        failed = _whole_mission(Flights(rig, bench.rng("disk full"), bench.tell))
        rig.pump(2.0)
        pid, note = rig.pid("recorder"), rig.health["recorder"].note
        failed += [
            f"the recorder was started again {n} times" for n in [rig.supervisor.children["recorder"].restarts] if n
        ]
        failed += [] if "disk" in note or "space" in note else [f"the recorder says nothing of the disk: {note!r}"]
        inside = Path(f"/proc/{pid}/root") / disk.relative_to("/")
        messages, words = _readable(sorted(inside.glob("*.mcap")))
    return Result((*failed, *words), {"messages": float(messages)}, (f"recorder: {note}",))


def _readable(paths: list[Path]) -> tuple[int, list[str]]:
    """Return how many chunks and messages can be read of recordings, and what is wrong with them."""
    from mcap.stream_reader import StreamReader

    count, empty = 0, 0
    for path in paths:
        before = count
        with (
            path.open("rb") as stream,
            contextlib.suppress(Exception),
        ):  # a cut file ends in whatever the library raises
            for record in StreamReader(stream).records:
                count += type(record).__name__ in {"Chunk", "Message"}
        empty += count == before
    words = ["no message can be read"] * (count == 0)
    return count, words + [f"{empty} empty files"] * (empty > _EMPTY_MOST)


def _damaged(rng: np.random.Generator, text: str) -> dict[str, bytes]:
    """Return damaged configurations by what is wrong with them."""
    values = json.loads(text)
    return {
        "cut short": text[: int(rng.integers(10, len(text) - 10))].encode(),
        "noise": rng.bytes(400),
        "unknown key": json.dumps({**values, "nonsense": 1}).encode(),
        "wrong value": json.dumps({**values, "log_level": 7}).encode(),
    }


def _corrupt_config(bench: Bench) -> Result:
    folder, rng = bench.fresh(), bench.rng("corrupt config")
    text = TreedockConfig().model_dump_json()
    failed, slowest = list[str](), 0.0
    kinds = list(_damaged(rng, text))
    services = (*ONBOARD, *FUSED, "preview", "station", "simulator")
    for k, service in enumerate(services):
        kind = kinds[k % len(kinds)]
        path = folder / f"{service}.json"
        path.write_bytes(_damaged(rng, text)[kind])
        begin_s = time.monotonic()
        try:
            done = subprocess.run(
                [sys.executable, "-m", "services.cli.app", service, "--config", str(path)], capture_output=True, text=True,
                timeout=60.0, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            failed.append(f"{service}, {kind}: still running after 60 s")
            continue
        slowest = max(slowest, time.monotonic() - begin_s)
        said = done.stderr.strip().splitlines()
        if done.returncode != 2 or len(said) != 1 or str(path) not in said[0]:
            failed.append(f"{service}, {kind}: exit {done.returncode}, {said[-1:] or 'no word'} ({len(said)} lines)")
    failed += [f"took {slowest:.1f} s"] if slowest > 10.0 else []
    return Result(tuple(failed), {"slowest_s": round(slowest, 2)}, (f"{len(services)} services",))


def _config_in_flight(bench: Bench) -> Result:
    tried = list[bool]()

    def harm(flights: Flights) -> Back:
        rig = flights.rig
        path = rig.config_file("recorder")
        good = path.read_bytes()
        path.write_bytes(b"\x00\xff not a configuration")
        try:
            pid, at_s = rig.harm("recorder")
            tried.append(rig.until(lambda: rig.supervisor.children["recorder"].deaths_in_a_row >= 2, 40.0))
        finally:
            path.write_bytes(good)
        back = rig.comeback("recorder", pid, at_s, 60.0)
        return Back(back_s=back.back_s if back else NEVER_S)

    result = passing(bench, "config corrupted in flight", harm, lands=False)
    untried = [f"not tried again in {tried.count(False)} of {len(tried)} cases"] * (not all(tried))
    return Result((*result.failed, *untried), result.measured, result.told)
