"""An aircraft without a camera: the real mission over a small world, on the real bus.

As a process: ``python -m tests.station.stub_aircraft PORT UAV [SPEED] [SEED]``; with STUB_CAMERA set it has one after all,
rendered, for the preview alone; with STUB_FUSION it has fusion.
"""

from __future__ import annotations

import math
import os
import sys
from typing import TYPE_CHECKING, get_args

import numpy as np

from schemas.command import Command, CommandReply, NonceReply, NonceRequest
from schemas.fusion import FusionState
from schemas.health import Health
from schemas.orders import CommandName
from schemas.sketch import SubmapSketch
from schemas.topics import (
    COMMAND,
    COMMAND_NONCE,
    FUSION_STATE,
    HEALTH,
    MAP_SKETCH,
    MISSION_STATE,
    PREVIEW_IMAGE,
    SLAM_POSE,
    TREES_LIST,
    TREES_TARGET,
    VEHICLE_STATE,
)
from schemas.trees import Tree, TreeList
from services.common.config import TreedockConfig
from services.common.geometry import wrap_angle
from services.common.health import HealthReporter
from services.common.live_context import LiveContext
from services.common.runtime import run_service
from services.common.stop import end_process
from services.navigator.commands import CommandDesk
from services.router.config import RouterConfig
from tests.unit.navigator_world import SERVICES, STEP_S, World, tree

if TYPE_CHECKING:
    from tests.station.stub_camera import StubCamera

_COVARIANCE = tuple(
    {0: 4e-4, 6: 4e-4, 11: 4e-4, 15: 1e-5, 18: 1e-5, 20: 1e-5}.get(i, 0.0) for i in range(21)
)  # fmt: skip
_TICK_S = 0.1
_VIEW_RAD = math.radians(59.0) / 2.0


def forest(seed: int) -> list[Tree]:
    """Trees around the start, some too thick or too thin, none where the aircraft stands."""
    rng = np.random.default_rng(seed)
    found: list[Tree] = []
    while len(found) < 14:
        x, y = rng.uniform(-7.0, 8.0), rng.uniform(-6.5, 6.5)
        clear = all(math.hypot(t.x_m - x, t.y_m - y) > 1.6 for t in found)
        if math.hypot(x, y) > 2.4 and clear:
            thick = rng.random() < 0.2
            radius = float(rng.uniform(0.21, 0.30) if thick else rng.uniform(0.05, 0.17))
            found.append(tree(len(found) + 1, float(x), float(y), radius, suitable=not thick))
    return found


def cloud_of(trees: list[Tree], seed: int, points: int = 300_000) -> list[SubmapSketch]:
    """The ground and the trunks as a cloud of sixty submaps, brown below and green above."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-9.0, 9.0, (points // 2, 2)), rng.normal(-0.1, 0.02, points // 2)])
    each = (points - len(ground)) // len(trees)
    parts = [ground]
    for t in trees:
        turn, height = rng.uniform(0.0, 2.0 * np.pi, each), rng.uniform(0.0, 2.5, each)
        r = t.radius_m + rng.normal(0.0, 0.006, each)
        parts.append(np.column_stack([t.x_m + r * np.cos(turn), t.y_m + r * np.sin(turn), t.z_m + height]))
    cloud = rng.permutation(np.concatenate(parts))
    share = np.clip((cloud[:, 2:3] + 0.2) / 2.7, 0.0, 1.0)
    colour = ((1.0 - share) * [139, 106, 72] + share * [58, 158, 92] + rng.normal(0.0, 12.0, (len(cloud), 1))).clip(
        0, 255
    )
    return [
        SubmapSketch(map_id="m1", submap_id=k, version=1, stamp_ns=1, T_map_submap=np.eye(4),
                     points_cm=np.rint(100.0 * cloud[part]).astype(np.int16), colour=colour[part].astype(np.uint8))
        for k, part in enumerate(np.array_split(np.arange(len(cloud)), -(-len(cloud) // SubmapSketch.MAX_POINTS)))
    ]  # fmt: skip


class StubAircraft:
    """Steps the world, publishes what the aircraft's services would, answers commands."""

    def __init__(self, context: LiveContext, speed: int, seed: int) -> None:
        self.context = context
        self.world = World(trees=forest(seed), station=False)
        self.speed = speed
        self.known: dict[int, Tree] = {}
        self.version = 0
        self.desk = CommandDesk(10.0, lambda: os.urandom(16))
        self._rng = np.random.default_rng(seed)
        self._reporters = {name: HealthReporter(name, context.health) for name in (*SERVICES, "navigator", "autopilot")}
        self._heard_station_s = -1.0
        self._ticks = 0
        self._camera: StubCamera | None = None
        if os.environ.get("STUB_CAMERA"):
            from tests.station.stub_camera import StubCamera  # it takes seconds to load

            self._camera = StubCamera(self.world.trees, seed)

    def register(self) -> None:
        c = self.context
        for name in self._reporters:
            if name != c.service:
                c.bus.declare_live(name)
        c.on(HEALTH, self._on_station, leaf="station")
        c.answer(COMMAND_NONCE, NonceRequest, self._on_nonce)
        for name in get_args(CommandName):
            c.answer(COMMAND, Command, self._on_command, leaf=name)
        sketches = cloud_of(self.world.trees, 1)
        c.answer_state(MAP_SKETCH, lambda: list(sketches))
        c.every_wall(_TICK_S, self.tick)
        c.every_wall(1.0, self._tell_health)

    def tick(self) -> None:
        world, c = self.world, self.context
        for _ in range(max(1, round(self.speed * _TICK_S / STEP_S))):
            world.battery = max(0.0, (world.battery or 0.0) - (2e-5 if world.armed else 0.0))
            world.step()
        self._ticks += 1
        world.revision += self._ticks % 50 == 0  # the mission's own list stays young
        assert world.outputs is not None
        assert world._pose is not None
        pose = world._pose.message.model_copy(update={"covariance": _COVARIANCE, "seq": self._ticks})
        c.publish(SLAM_POSE, pose)
        if world._vehicle is not None:
            c.publish(VEHICLE_STATE, world._vehicle.message.model_copy(update={"seq": self._ticks}))
        if world._target is not None:
            c.publish(TREES_TARGET, world._target.message.model_copy(update={"seq": self._ticks}))
        c.publish(MISSION_STATE, world.outputs.state.model_copy(update={"seq": self._ticks}))
        if "STUB_FUSION" in os.environ:
            c.publish(FUSION_STATE, self._fused(world.now_ns))
        if self._camera is not None and self._ticks % 3 == 0 and c.listened(PREVIEW_IMAGE):
            known = tuple(self.known.values())
            target = None if world._target is None else world._target.message
            c.publish(
                PREVIEW_IMAGE, self._camera.picture(pose, known, target, world.outputs.state, world.outputs.guidance)
            )
        if self._look():
            self.version += 1
            trees = tuple(self.known[k] for k in sorted(self.known))
            c.publish(TREES_LIST, TreeList(stamp_ns=world.now_ns, map_id=world.map_id, version=self.version, graph_version=0, trees=trees))  # fmt: skip

    def _fused(self, now_ns: int) -> FusionState:
        """Fusion that carries the pose by IMU for good, and does not believe its GPS."""
        nothing = (0.0, 0.0, 0.0)
        return FusionState(
            stamp_ns=now_ns, seq=self._ticks, map_id=self.world.map_id, carrier="imu", carried_s=0.4, gps="distrusted",
            gps_word="it jumped by 10.2 m", place=None, accel_bias_m_s2=nothing, gyro_bias_rad_s=nothing, restarts=0, jumps_announced=0,
        )  # fmt: skip

    def _look(self) -> bool:
        """Take in the trees that the camera sees: each look makes the belief better."""
        world = self.world
        if world.position_m[2] < 1.0 or self._ticks % 5:
            return False
        changed = False
        for t in world.trees:
            dx, dy = t.x_m - world.position_m[0], t.y_m - world.position_m[1]
            far = math.hypot(dx, dy)
            if far > 7.5 or abs(wrap_angle(math.atan2(dy, dx) - world.yaw_rad)) > _VIEW_RAD:
                continue
            looks = self.known[t.id].observations + 1 if t.id in self.known else 1
            sigma = 0.12 / math.sqrt(looks)
            noise = self._rng.normal(0.0, sigma / 3.0, 3)
            self.known[t.id] = t.model_copy(update={
                "x_m": t.x_m + float(noise[0]), "y_m": t.y_m + float(noise[1]), "radius_m": max(0.02, t.radius_m + float(noise[2]) / 10),
                "sigma_xy_m": sigma, "sigma_radius_m": sigma / 10, "observations": looks, "confidence": 1.0 - 0.6 / looks,
            })  # fmt: skip
            changed = True
        return changed

    def _tell_health(self) -> None:
        self.world.station = self.context.wall.now_ns() * 1e-9 - self._heard_station_s < 2.5
        for name, reporter in self._reporters.items():
            if name not in self.world.dead:
                health = reporter.report(self.context.wall.now_ns(), self.context.bus.passed)
                if name != self.context.service:
                    self.context.publish(HEALTH, health, leaf=name)

    def _on_station(self, _: Health) -> None:
        self._heard_station_s = self.context.wall.now_ns() * 1e-9

    def _on_nonce(self, request: NonceRequest) -> NonceReply:
        return self.desk.issue(request.sender, self.context.wall.now_ns())

    def _on_command(self, command: Command) -> CommandReply:
        reason = self.desk.refusal(command, self.context.wall.now_ns())
        if reason:
            return CommandReply(accepted=False, reason=reason, state=self.world.state)
        verdict = self.world.mission.order(command.name, command.tree_id, self.world.now_ns)
        return CommandReply(accepted=verdict.accepted, reason=verdict.reason, state=self.world.state)


def main(port: int, uav: str, speed: int, seed: int) -> int:
    config = TreedockConfig(router=RouterConfig(port=port), uav=uav)
    return run_service("navigator", lambda c: StubAircraft(c, speed, seed).register(), config)


if __name__ == "__main__":
    arguments = sys.argv[1:] + ["1", "0"][len(sys.argv) - 3 :]
    end_process(main(int(arguments[0]), arguments[1], int(arguments[2]), int(arguments[3])))
