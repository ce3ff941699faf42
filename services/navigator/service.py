"""The navigator process: gathers the latest messages, steps the mission at a fixed rate, answers commands."""

from __future__ import annotations

import functools
import logging
import os
import secrets
from collections.abc import Callable
from typing import get_args

from schemas.camera import RgbdFrame
from schemas.command import Command, CommandReply, NonceReply, NonceRequest
from schemas.fleet import ClaimReply, HeldState
from schemas.health import Health
from schemas.orders import CommandName
from schemas.slam import Pose
from schemas.topics import (
    CAMERA_COMPRESSED,
    CAMERA_RGBD,
    COMMAND,
    COMMAND_NONCE,
    FLEET_CLAIM,
    FLEET_HELD,
    FUSION_POSE,
    HEALTH,
    MISSION_GUIDANCE,
    MISSION_STATE,
    SLAM_POSE,
    TREES_LIST,
    TREES_TARGET,
    VEHICLE_STATE,
)
from schemas.trees import Target, TreeList
from schemas.vehicle import VehicleState
from services.camera.depth_codec import FrameError, decode_depth
from services.common.context import Context
from services.common.process import take_small_arrays, take_small_objects
from services.doctor.model import ServiceFact
from services.doctor.told import told
from services.doctor.twins import Twins
from services.fleet.config import ClaimConfig
from services.fleet.holder import Asked, ClaimView, Holder, Wish
from services.navigator.commands import CommandDesk
from services.navigator.config import NavigatorConfig
from services.navigator.guard import View, look
from services.navigator.mission import Mission
from services.navigator.values import Inputs, Outputs, Seen

LOG = logging.getLogger(__name__)

WATCHED = ("camera", "slam", "fusion", "mapper", "detector", "refiner", "autopilot", "station")
"""Services whose health the failsafes look at."""
_ASKED = (*WATCHED, "router", "recorder", "preview", "navigator")
"""Services whose word preflight wants; the navigator's, for there may be another."""
_STATE_EVERY = 4
_TELL_CLAIMS_S = 1.0
_UNGUARDED = frozenset({"idle", "landed", "failed", "released"})
"""States in which nothing is flown: the eyes are closed."""
_CARRY_NS = 300_000_000
"""A pose older than this is not carried on to a frame's stamp: the view is good for the sweep only."""


class ClaimDesk:
    """Joins the mission's wishes to the arbiter, where claims are switched on: questions leave without being waited for.

    Leases are counted on the machine's steady clock: simulated time may stand still while the arbiter's runs on.
    """

    def __init__(self, context: Context, config: ClaimConfig) -> None:
        self._context = context
        self._config = config
        self._holder = Holder(config, lambda: secrets.randbits(62))
        self._told = 0
        self._map_id = "none"
        context.every_wall(_TELL_CLAIMS_S, self._tell)

    def view(self) -> ClaimView:
        """Return what the mission is to know now."""
        return self._holder.view(self._context.steady_ns())

    def follow(self, wish: Wish) -> None:
        """Do what a step of the mission wants, and ask what is due."""
        c = self._context
        self._holder.follow(wish)
        self._map_id = wish.map_id or self._map_id
        for asked in self._holder.questions(c.steady_ns()):
            c.health.count(f"claims_{asked.request.kind}")
            then = functools.partial(self._answered, asked)
            c.ask_later(FLEET_CLAIM, asked.request, ClaimReply, self._config.ask_timeout_s, then)

    def _answered(self, asked: Asked, replies: list[ClaimReply]) -> None:
        self._holder.answered(asked, replies, self._context.steady_ns())
        if not replies:
            self._context.health.count("claims_unanswered")

    def _tell(self) -> None:
        c, holder = self._context, self._holder
        view = self.view()
        c.publish(FLEET_HELD, HeldState(
            stamp_ns=c.clock.now_ns(), seq=self._told, map_id=self._map_id, held=view.held, left_s=view.left_s,
            asked=None if holder.asked is None else holder.asked.goal, undelivered=view.undelivered, note=view.note[:400],
        ))  # fmt: skip
        self._told += 1


class Navigator:
    """Holds the latest of everything and the mission."""

    def __init__(self, context: Context, config: NavigatorConfig, *, fused: bool = False) -> None:
        self._context = context
        self._fused = fused
        self.mission = Mission(config)
        self.desk = CommandDesk(config.nonce_valid_s, lambda: os.urandom(16))
        self._pose: Seen[Pose] | None = None
        self._trees: Seen[TreeList] | None = None
        self._target: Seen[Target] | None = None
        self._vehicle: Seen[VehicleState] | None = None
        self._view: Seen[View] | None = None
        self._services: dict[str, int] = {}
        self._aboard: dict[str, ServiceFact] = {}
        self._twins = Twins()
        self._steps = self._states = 0
        self._claims = ClaimDesk(context, config.claims) if config.claims.enabled else None

    def register(self, rate_hz: float) -> None:
        """Connect to the bus."""
        c = self._context
        c.on(FUSION_POSE if self._fused else SLAM_POSE, self._on_pose)
        if self.mission.config.live_guard:
            c.on(CAMERA_COMPRESSED if self.mission.config.frames == "compressed" else CAMERA_RGBD, self._on_frame)
        c.on(TREES_LIST, self._on_trees)
        c.on(TREES_TARGET, self._on_target)
        c.on(VEHICLE_STATE, self._on_vehicle)
        for service in _ASKED:
            c.on(HEALTH, self._on_health, leaf=service)
        c.answer(COMMAND_NONCE, NonceRequest, self._on_nonce)
        for name in get_args(CommandName):
            c.answer(COMMAND, Command, self._on_command_named(name), leaf=name)
        c.every(1.0 / rate_hz, self.step)

    def step(self) -> None:
        """Step the mission and publish what it says."""
        now_ns = self._context.clock.now_ns()
        inputs = Inputs(
            now_ns, self._pose, self._trees, self._target, self._vehicle, dict(self._services), self._view,
            tuple(self._aboard.values()), None if self._claims is None else self._claims.view(),
        )  # fmt: skip
        with self._context.health.timed("step"):
            outputs = self.mission.step(inputs)
        if self._claims is not None:
            self._claims.follow(outputs.wish)
        self._publish(outputs)

    def _publish(self, outputs: Outputs) -> None:
        c = self._context
        c.publish(MISSION_GUIDANCE, outputs.guidance)
        self._steps += 1
        if outputs.events or self._steps % _STATE_EVERY == 0:
            # numbered as sent: gaps would count as lost messages at the receivers
            c.publish(MISSION_STATE, outputs.state.model_copy(update={"seq": self._states}))
            self._states += 1
        for event in outputs.events:
            LOG.info("%s -> %s: %s", event.before, event.after, event.reason)
        c.health.count("steps")
        c.health.count("transitions", len(outputs.events))
        word = outputs.state.failsafe
        c.health.note("failsafe", f"{word}: {outputs.state.reason}" if word else "")

    def _on_pose(self, pose: Pose) -> None:
        self._pose = Seen(pose, self._context.clock.now_ns())

    def _on_frame(self, frame: RgbdFrame) -> None:
        """Look at the depth while there is a way to guard; a damaged frame counts as none."""
        track = self.mission.board.track
        here = track.latest
        if self.mission.state in _UNGUARDED or here is None:
            return
        i = frame.intrinsics
        with self._context.health.timed("guard"):
            try:
                depth = decode_depth(frame.depth, frame.depth_encoding, i.width, i.height)
            except FrameError as error:
                self._context.health.count("frames_refused")
                LOG.warning("the guard refused a frame: %s", error)
                return
            young = not track.lost and abs(frame.stamp_ns - here.stamp_ns) <= _CARRY_NS
            T = track.predict(frame.stamp_ns) if young else here.T_map_camera
            key = (here.map_id, here.reset_counter) if young else None
            view = look(depth, i, T, frame.stamp_ns, key)
        self._view = Seen(view, self._context.clock.now_ns())

    def _on_trees(self, trees: TreeList) -> None:
        self._trees = Seen(trees, self._context.clock.now_ns())

    def _on_target(self, target: Target) -> None:
        self._target = Seen(target, self._context.clock.now_ns())

    def _on_vehicle(self, vehicle: VehicleState) -> None:
        self._vehicle = Seen(vehicle, self._context.clock.now_ns())

    def _on_health(self, health: Health) -> None:
        clock = self._context.clock
        now_ns = clock.now_ns()
        self._services[health.service] = now_ns
        if health.state == "stopping":
            self._aboard.pop(health.service, None)
            return
        # stamps of health are the wall's
        offset_s = None if clock.simulated else 1e-9 * (health.stamp_ns - now_ns)
        twice = self._twins.hear(health, 1e-9 * self._context.steady_ns())
        self._aboard[health.service] = told(health, clock_offset_s=offset_s, twice=twice)

    def _on_nonce(self, request: NonceRequest) -> NonceReply:
        return self.desk.issue(request.sender, self._context.steady_ns())

    def _on_command_named(self, name: CommandName) -> Callable[[Command], CommandReply]:
        def handle(command: Command) -> CommandReply:
            return self._on_command(name, command)

        return handle

    def _on_command(self, name: CommandName, command: Command) -> CommandReply:
        now_ns = self._context.clock.now_ns()
        # not by the clock: it is the wall's, and set back by an hour it would let a command of an hour ago be fresh
        reason = self.desk.refusal(command, self._context.steady_ns())
        if not reason and command.name != name:
            reason = f"sent to cmd/{name} but named {command.name}"
        if reason:
            self._context.health.count("commands_refused")
            LOG.info("command %s of %s refused: %s", name, command.sender, reason)
            return CommandReply(accepted=False, reason=reason, state=self.mission.state)
        verdict = self.mission.order(command.name, command.tree_id, now_ns)
        LOG.info("command %s of %s: %s", name, command.sender, verdict.reason)
        self._context.health.count("commands_accepted" if verdict.accepted else "commands_refused")
        return CommandReply(accepted=verdict.accepted, reason=verdict.reason[:500], state=self.mission.state)


def build(context: Context) -> None:
    """Start the navigator on a context."""
    take_small_arrays()  # each view has its own number of rays that saw something
    take_small_objects()  # a plan round many things
    config = getattr(context.config, "navigator", None) or NavigatorConfig()
    Navigator(context, config, fused=context.config.fusion.enabled).register(config.rate_hz)
