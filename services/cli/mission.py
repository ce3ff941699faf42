"""The mission's part of ``treedock run``: who flies it, the start command, and how it ended."""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from schemas.navigation import MissionState
from schemas.simulation import SimTruth
from schemas.slam import Pose
from schemas.topics import MISSION_STATE, SIM_TRUTH, SLAM_POSE, TREES_TARGET, VEHICLE_STATE
from schemas.trees import Target
from schemas.vehicle import VehicleState

if TYPE_CHECKING:
    from services.cli.watch import Watch
    from services.common.config import TreedockConfig

_ASK_AGAIN_S = 1.0
_SETTLE_S = 20.0
"""After the mission's end, the longest wait for the simulator to say that the aircraft is parked."""
_LAST_WORD_S = 3.0
_STAND_S = 10.0
_END = frozenset({"landed", "failed", "released"})


def flies(tree: TreedockConfig) -> bool:
    """Return whether a run of this configuration flies a mission."""
    return tree.camera.source == "sim" and tree.simulator.mode != "scan" and not tree.navigator.handheld


def guides(tree: TreedockConfig) -> bool:
    """Return whether a run has a mission: flown, or shown to the person who carries the camera."""
    return flies(tree) or tree.navigator.handheld


def prepared(tree: TreedockConfig, autopilot: str) -> TreedockConfig:
    """Return ``tree`` with simulator and bridge joined on a free UDP port, so that runs side by side do not clash.

    ``autopilot``: builtin, or ``udpin:HOST:PORT`` (``udpout:...``) where a PX4 in simulation speaks MAVLink. Then the
    simulator owns that address and hands on to the bridge what is meant for it: never the true pose.

    Raises:
        InputError: neither form, or the address is in use.
    """
    from services.common.errors import InputError
    from services.simulator.px4.config import LinkConfig

    builtin = autopilot == "builtin"
    if tree.navigator.handheld and tree.camera.source == "sim":
        # the scripted path is the person, who stands still before the tree for as long as docking takes
        path = tree.simulator.path.model_copy(update={"hold_s": max(tree.simulator.path.hold_s, _STAND_S)})
        simulator = tree.simulator.model_copy(update={"mode": "scan", "path": path})
        return tree.model_copy(update={"simulator": simulator, "clock": "sim"})
    if tree.camera.source != "sim":
        if builtin:
            return tree
        return tree.model_copy(update={"autopilot": tree.autopilot.model_copy(update={"connection": autopilot})})
    if tree.simulator.mode == "scan":
        if not builtin:
            raise InputError(f"--autopilot {autopilot!r}: simulator.mode scan flies no autopilot, give builtin")
        return tree.model_copy(update={"clock": "sim"})
    port = _free_udp_port()
    bridge = tree.autopilot.model_copy(update={"connection": f"udpin:127.0.0.1:{port}"})
    if builtin:
        px4 = tree.simulator.px4.model_copy(update={"links": (LinkConfig(local_port=0, remote_port=port),)})
        simulator = tree.simulator.model_copy(update={"mode": "flight", "px4": px4})
    else:
        _check_address(autopilot)
        external = tree.simulator.external.model_copy(
            update={"endpoint": autopilot, "bridge": f"udpout:127.0.0.1:{port}"}
        )
        simulator = tree.simulator.model_copy(update={"mode": "external", "reduced": True, "external": external})
    clock = "sim" if builtin else "wall"
    return tree.model_copy(update={"autopilot": bridge, "simulator": simulator, "clock": clock})


def _check_address(autopilot: str) -> None:
    from services.common.errors import InputError

    kind, _, rest = autopilot.partition(":")
    host, _, port = rest.rpartition(":")
    if kind not in {"udpin", "udpout"} or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise InputError(f"--autopilot {autopilot!r}: expected builtin, udpin:HOST:PORT or udpout:HOST:PORT")
    if kind == "udpin":
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((host, int(port)))
            except OSError as error:
                raise InputError(f"--autopilot {autopilot!r}: {error.strerror}; what else listens there?") from error


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Flown:
    """What was said during a flight: the belief and, in simulation, the truth. All in order of arrival."""

    states: list[MissionState] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    truths: list[SimTruth] = field(default_factory=list)


class Conductor:
    """Orders the start when everything is ready, and follows the mission to its end. Called from one loop."""

    def __init__(self, watch: Watch, within_s: float, trees_wanted: int = 1, *, handheld: bool = False) -> None:
        self._handheld = handheld
        """Nothing is flown: no vehicle is asked for, and the end of the pictures is the end."""
        self._watch = watch
        self._trees_wanted = trees_wanted
        self._within_s = within_s
        self.flown = Flown()
        self.vehicle: VehicleState | None = None
        self.target: Target | None = None
        self.word = ""
        """Why the start was refused last."""
        self._started = False
        self._asked_s = self._begin_s = time.monotonic()
        self._ended_s: float | None = None
        bus = watch.bus
        bus.subscribe(VEHICLE_STATE, self._on_vehicle)
        bus.subscribe(MISSION_STATE, self._on_state)
        bus.subscribe(TREES_TARGET, self._on_target)
        bus.subscribe(SLAM_POSE, self.flown.poses.append)
        bus.subscribe(SIM_TRUTH, self.flown.truths.append)

    def update(self, *, ready: bool) -> bool:
        """Do what is due; ``ready``: all services are. Return whether the mission is over."""
        now_s = time.monotonic()
        if not self._started and self._sources_end:
            self.word = self.word or "the pictures ended before the mission could begin"
            return True
        if not self._started:
            lacking = self._lacking
            if ready and lacking:
                self.word = lacking
            elif ready and now_s - self._asked_s >= _ASK_AGAIN_S:
                self._asked_s = now_s
                self._start()
        elif self._over and self._ended_s is None:
            self._ended_s = now_s
        if now_s - self._begin_s > self._within_s:
            begun = "ended" if self._started else "begun"
            self.word = f"not {begun} within {self._within_s:.0f} s{self.word and ': '}{self.word}"
            return True
        if self._ended_s is None:
            return False
        parked = self._watch.clock is None or self._watch.clock.phase == "done" or self.state == "failed"
        if parked and self.state not in _END and not self._handheld:  # the simulator saw it first
            return now_s - self._ended_s > _LAST_WORD_S
        return parked or now_s - self._ended_s > _SETTLE_S

    @property
    def state(self) -> str:
        """The mission's last state."""
        return self.flown.states[-1].state if self.flown.states else "idle"

    @property
    def _lacking(self) -> str:
        """What must come before the start can be ordered, in words; empty when all is there."""
        pose, vehicle = self._watch.pose, self.vehicle
        if not self._handheld and (vehicle is None or not vehicle.connected):
            return "waiting for the autopilot to speak: is it running, does it send MAVLink to this address?"
        if pose is None or pose.status != "tracking":
            return "waiting for slam's first pose: does the camera see something?"
        return ""

    @property
    def _sources_end(self) -> bool:
        """Whether a recording, or the scripted path, is over: then a person stands still."""
        return self._handheld and self._watch.source_ended

    @property
    def _over(self) -> bool:
        stopped = self._watch.clock is not None and self._watch.clock.phase == "done"
        return self.state in _END or stopped or self._sources_end

    def _start(self) -> None:
        from services.navigator.client import send_command

        reply = send_command(self._watch.bus, "start", sender="run")
        self.word = "no answer from the navigator" if reply is None else "" if reply.accepted else reply.reason
        if reply is not None and reply.accepted:
            self._started = True
            self.flown.states.clear()

    def _on_vehicle(self, message: VehicleState) -> None:
        self.vehicle = message

    def _on_state(self, message: MissionState) -> None:
        self.flown.states.append(message)

    def _on_target(self, message: Target) -> None:
        self.target = message
        self.flown.targets.append(message)

    def headline(self) -> str:
        """Return the mission in a few words: its reason and how far the target is."""
        parts = []
        if self.flown.states:
            last = self.flown.states[-1]
            parts.append(last.reason)
            if last.target_tree_id is not None and last.distance_m is not None:
                parts.append(f"tree {last.target_tree_id} at {last.distance_m:.2f} m")
        if self.word:
            parts.append(self.word)
        return ", ".join(parts)

    def figures(self) -> dict[str, Any]:
        """Return how it ended, as plain values: the believed beside the true."""
        from services.evaluate.flown import mission_figures

        values = mission_figures(self.flown, self._trees_wanted)
        if self.word:
            values["reason"] = self.word
        return values
