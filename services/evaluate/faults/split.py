"""The aircraft's services over three machines with a router between, and what happens when a cable is pulled.

``python -m services.evaluate.faults.split ROW SEED MOMENTS FOLDER`` in namespaces of its own (``hosts.enter_fresh``); prints the
row's result as JSON, progress goes to stderr.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from services.common.config import TreedockConfig
from services.common.process import prepare_process
from services.common.timekeeping import told_ahead_s
from services.evaluate.faults.hosts import HUB, Hosts, enter_fresh, why_not
from services.evaluate.faults.missions import NEVER_S, Back, Flights, Seen, line_of
from services.evaluate.faults.model import Result
from services.evaluate.faults.rig import STANDINS, Rig
from services.evaluate.faults.system import flight_config
from services.evaluate.faults.verdict import common, held_late, summary

PLACES = {
    "simulator": "A", "camera": "A", "autopilot": "A", "slam": "B", "refiner": "B", "mapper": "C", "detector": "C",
    "navigator": "C",
}  # fmt: skip
AHEAD_S = {"A": 0.0, "B": 0.2, "C": -0.2}
"""By how much each machine's clock is ahead of the router's."""
_CLOCK_S = 0.02
_HEALTHS, _HEALTHS_S = 5, 12.0
"""So many, and so long for them."""
_MOMENT_S = 0.35
"""What is uncertain of a fault's moment: time is let run on after 0.3 s of silence, and the news is as old as the way."""
_DOCK_WITHIN_S = 200.0
_AGAIN_WITHIN_S = 30.0
_DOWN_WITHIN_S = 120.0
_ARMED_WITHIN_S = 60.0


def split_rig(hosts: Hosts, seed: int, folder: Path, *, real: bool = False, waits: bool = True) -> Rig:
    """Return the system over the hosts; ``real``: rendered, with no stand-ins; ``waits``: time waits for who is silent."""
    base = flight_config(seed, folder)
    simulator = base.simulator
    if not waits:
        flight = simulator.flight.model_copy(update={"max_speed": 1.0, "hung_after_s": 0.3})
        simulator = simulator.model_copy(update={"flight": flight})
    if real:
        simulator = TreedockConfig().simulator.model_copy(update={
            "seed": seed, "reduced": True, "px4": base.simulator.px4,
            "flight": TreedockConfig().simulator.flight.model_copy(update={"again": True}),
        })  # fmt: skip
    compressed = {"frames": "compressed"}
    config = base.model_copy(update={
        "router": base.router.model_copy(update={"host": HUB}),
        "slam": base.slam.model_copy(update=compressed), "refiner": base.refiner.model_copy(update=compressed),
        "navigator": base.navigator.model_copy(update=compressed), "simulator": simulator,
    })  # fmt: skip

    def configured(name: str, tree: TreedockConfig) -> TreedockConfig:
        return tree.model_copy(update={"clock_ahead_s": AHEAD_S[PLACES[name]]}) if name in PLACES else tree

    return Rig(
        config, folder, ("router", *PLACES), standins=frozenset() if real else STANDINS, configured=configured,
        prefix=lambda name: hosts.run_on(PLACES[name]) if name in PLACES else [],
    )  # fmt: skip


def docks(
    hosts: Hosts, seed: int, moments: int, folder: Path, tell: Callable[[str], None], *, real: bool = False
) -> Result:
    """Fly a mission over three machines whose clocks differ."""
    del moments
    failed: list[str] = []
    with split_rig(hosts, seed, folder, real=real) as rig:
        flights = Flights(rig, np.random.default_rng(seed), tell)
        flights.begin()
        before, poses = {name: hosts.sent_to(name) for name in "BC"}, rig.flown.poses
        docked = rig.until(lambda: rig.flown.docks > 0, _DOCK_WITHIN_S)
        frames = max(rig.flown.poses - poses, 1)
        per_frame = {name: (hosts.sent_to(name) - sent) / frames for name, sent in before.items()}
        if not docked:
            failed.append(f"not docked: {rig.flown.state}, {rig.flown.reason()}")
        failed += [f"{name} has {word}" for name in ("slam", "navigator") if (word := _wrong_frames(rig, name))]
        raw = 5.0 * (640 * 480 if real else 320 * 240)
        failed += [
            f"{b:.0f} bytes a frame went to {n}, a raw one has {raw:.0f}" for n, b in per_frame.items() if b > 0.5 * raw
        ]
        off = {name: clock_off_s(rig, name) for name in PLACES}
        failed += [f"{n}: clock measured {o:+.3f} s, is {AHEAD_S[PLACES[n]]:+.1f}" for n, (o, _) in off.items()
                   if abs(o - AHEAD_S[PLACES[n]]) > _CLOCK_S]  # fmt: skip
        failed += [f"{n}: {r:+.3f} s off after the correction" for n, (_, r) in off.items() if abs(r) > _CLOCK_S]
        failed += _doctor(rig)
        touches = rig.flown.touches
        failed += [f"{touches} touches"] * bool(touches)
        flights.land()
    measured = {
        "clock_off_s": max(abs(r) for _, r in off.values()), "kb_a_frame_B": per_frame["B"] / 1e3, "kb_a_frame_C": per_frame["C"] / 1e3,
        "docked": float(docked),
    }  # fmt: skip
    told = ", ".join(f"{name} {1e3 * o:+.1f} ms, {1e3 * r:+.1f} left" for name, (o, r) in off.items())
    return Result(tuple(failed), measured, (f"docked {docked}; clocks: {told}",))


def _wrong_frames(rig: Rig, name: str) -> str:
    """Return what is wrong with the camera's frames that a service takes, by its own account."""
    rates = rig.health[name].rates_hz
    if rates.get("camera/rgbd", 0.0) > 0.0:
        return "raw frames from another machine"
    return "" if rates.get("camera/rgbd_compressed", 0.0) > 0.0 else "no compressed frames"


def clock_off_s(rig: Rig, name: str) -> tuple[float, float]:
    """Return how far ahead a service says its machine is, and how far its corrected clock is off this process's.

    This process runs on the router's machine. The second is the greatest of several healths: each is late by its way here.
    """
    seen, off_s = {rig.health[name].seq}, list[float]()

    def enough() -> bool:
        health = rig.health[name]
        if health.seq not in seen:
            seen.add(health.seq)
            off_s.append(rig.stamp_off_s(name))
        return len(off_s) >= _HEALTHS

    rig.until(enough, _HEALTHS_S)
    return told_ahead_s(rig.health[name].counters) or 0.0, max(off_s, default=float("inf"))


def _doctor(rig: Rig) -> list[str]:
    """Return whom the doctor does not name although its machine's clock is off."""
    command = [sys.executable, "-m", "services.cli.app", "doctor", "--json", "--config", str(rig.config_file("router"))]
    asked = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    rig.until(lambda: asked.poll() is not None, 60.0)
    if asked.poll() is None:
        asked.kill()
    out, _ = asked.communicate()
    off = [name for name, place in PLACES.items() if AHEAD_S[place]]
    lines = [json.dumps(f) for f in json.loads(out or '{"findings": []}')["findings"] if f["about"] == "clock"]
    return [
        f"doctor does not tell {name}'s clock: {lines}"
        for name in off
        if not any(f"{name}'s machine" in x for x in lines)
    ]


def cut(
    hosts: Hosts, seed: int, moments: int, folder: Path, tell: Callable[[str], None], *, host: str, for_s: float
) -> Result:
    """Pull a machine's cable at random moments; for good (until the aircraft is down) where ``for_s`` is infinite."""
    failed: list[str] = []
    seen: list[Seen] = []
    with split_rig(hosts, seed, folder, waits=False) as rig:
        flights = Flights(rig, np.random.default_rng([seed, ord(host)]), tell)

        def pull() -> Back:
            hosts.wire(host, up=False)
            rig.each = lambda: _looked_after_there(rig, host)
            if for_s < float("inf"):
                rig.pump(for_s)
            elif not rig.until(lambda: not rig.flown.armed, _DOWN_WITHIN_S):
                failed.append(f"still armed {_DOWN_WITHIN_S:.0f} s after the cable was pulled: {rig.flown.state}")
            hosts.wire(host, up=True)
            rig.each = lambda: None
            poses, at_s = rig.flown.poses, time.monotonic()
            behind = [name for name, place in PLACES.items() if place == host]

            def together() -> bool:
                heard = all(rig.heard_s.get(name, 0.0) > at_s for name in behind)
                return heard and rig.flown.poses > poses + 5 and rig.all_ready

            back = rig.until(together, _AGAIN_WITHIN_S)
            return Back(back_s=time.monotonic() - at_s if back else NEVER_S)

        for _ in range(moments):
            flights.moment()
            if for_s == float("inf") and not rig.until(lambda: rig.flown.armed, _ARMED_WITHIN_S):
                failed.append(f"never armed: {rig.flown.state}, {rig.flown.reason()}")
            one = flights.see(f"cable of {host} out for {for_s:g} s", pull)
            seen.append(one)
            failed += [f"{one.state}: {word}" for word in common(one)]
            failed += [f"{one.state}: {host} cut: {word}" for word in [held_late(one, _MOMENT_S)] if word]
            if one.back_s is not None and one.back_s > _AGAIN_WITHIN_S:
                failed.append(f"{one.state}: not together again within {_AGAIN_WITHIN_S:.0f} s")
        flights.land()
        again = [name for name, child in rig.supervisor.children.items() if child.restarts]
        failed += [f"{name} was started again" for name in again]
    return Result(tuple(failed), summary(seen), tuple(line_of(one) for one in seen))


def _looked_after_there(rig: Rig, host: str) -> None:
    """Tell the supervisor, which in truth every machine has one of, that the services behind the pulled cable live."""
    for name, place in PLACES.items():
        process = rig.supervisor.children[name].process
        if place == host and process is not None and process.poll() is None:
            rig.supervisor.heard(name, process.pid, "ready")


def in_namespaces(row: str, seed: int, moments: int, folder: Path, tell: Callable[[str], None]) -> Result:
    """Run one of ``CASES`` in a process with namespaces of its own; skipped, with the reason, where there are none."""
    if reason := why_not():
        return Result(skipped=reason)
    command = [
        *enter_fresh(),
        sys.executable,
        "-m",
        "services.evaluate.faults.split",
        row,
        str(seed),
        str(moments),
        str(folder),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as done:
        try:
            out, err = done.communicate()
        except BaseException:  # a test's time limit, ctrl-c: its services must not outlive it
            done.terminate()  # the namespaces' holders end with their parent
            raise
    for line in err.strip().splitlines()[-12:]:
        tell(line)
    if done.returncode or not out.strip():
        return Result((f"it broke down: {(err.strip().splitlines() or ['it said nothing'])[-1]}",))
    values = json.loads(out.strip().splitlines()[-1])
    return Result(tuple(values["failed"]), values["measured"], tuple(values["told"]), values["skipped"])


CASES: dict[str, Callable[[Hosts, int, int, Path, Callable[[str], None]], Result]] = {
    "split": docks,
    "split-rendered": lambda h, s, m, f, t: docks(h, s, m, f, t, real=True),
    "cut-B": lambda h, s, m, f, t: cut(h, s, m, f, t, host="B", for_s=float("inf")),
    "cut-C": lambda h, s, m, f, t: cut(h, s, m, f, t, host="C", for_s=float("inf")),
    "flap-B": lambda h, s, m, f, t: cut(h, s, m, f, t, host="B", for_s=1.0),
    "flap-C": lambda h, s, m, f, t: cut(h, s, m, f, t, host="C", for_s=1.0),
}  # fmt: skip


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
    sys.stderr.flush()


def main(row: str, seed: int, moments: int, folder: Path) -> None:
    """Run a case and print its result."""
    with Hosts(("A", "B", "C")) as hosts:
        result = CASES[row](hosts, seed, moments, folder, _to_stderr)
    sys.stdout.write(json.dumps(dataclasses.asdict(result)) + "\n")


if __name__ == "__main__":
    prepare_process()
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
