"""An aircraft of a fleet without a camera: the real mission and claim desk over a small world, on the real bus.

``python -m tests.process.claiming_aircraft PORT UAV``. Each knows the same trees by places and numbers of its own map.
"""

from __future__ import annotations

import sys

import numpy as np

from schemas.topics import MISSION_STATE, TREES_LIST
from schemas.trees import Tree
from services.common.config import TreedockConfig
from services.common.live_context import LiveContext
from services.common.runtime import run_service
from services.common.stop import end_process
from services.fleet.config import ClaimConfig
from services.fleet.holder import ClaimView
from services.navigator.config import NavigatorConfig
from services.navigator.service import ClaimDesk
from services.router.config import RouterConfig
from tests.unit.navigator_world import STEP_S, World, tree

LEASE_S = 12.0
CLAIMS = ClaimConfig(enabled=True, renew_s=1.0, retry_s=0.5, ask_timeout_s=0.4, reserve_s=5.0, hold_s=1.0)
FOREST = ((5.0, 0.5), (1.0, 5.2), (9.0, -5.2))
"""East and north of the first start, metres: the first tree is the nearest of both."""
STARTS = {"uav1": (0.0, 90.0), "uav2": (10.0, 270.0)}
"""East of the first start, and heading."""
NUMBERS = {"uav1": 1, "uav2": 51}
"""Of the first tree in each aircraft's list."""
_SPEED, _TICK_S = 6, 0.1


def forest_of(uav: str) -> list[Tree]:
    """Return the trees in an aircraft's own map."""
    east_m, heading_deg = STARTS[uav]
    turn = np.radians(90.0 - heading_deg)
    rows = []
    for k, (x, y) in enumerate(FOREST):
        p = np.array([x - east_m, y])
        own = np.array([np.cos(turn) * p[0] + np.sin(turn) * p[1], -np.sin(turn) * p[0] + np.cos(turn) * p[1]])
        rows.append(tree(NUMBERS[uav] + k, float(own[0]), float(own[1])))
    return rows


class FleetWorld(World):
    """The mission's world with the real desk for its claims."""

    desk: ClaimDesk

    def claims(self) -> ClaimView:
        if self.outputs is not None:
            self.desk.follow(self.outputs.wish)
        return self.desk.view()


def register(context: LiveContext) -> None:
    """Fly the mission, several times as fast as real time; claims are counted in real time all the same."""
    world = FleetWorld(
        NavigatorConfig(claims=CLAIMS, trees_wanted=9, live_guard=False, preflight_wait_s=300.0), forest_of(context.uav)
    )
    world.desk = ClaimDesk(context, CLAIMS)
    ticks = 0

    def tick() -> None:
        nonlocal ticks
        ticks += 1
        for _ in range(round(_SPEED * _TICK_S / STEP_S)):
            world.step()
        if ticks == 10:
            world.mission.order("start", None, world.now_ns)
        world.revision += ticks % 50 == 0
        assert world.outputs is not None
        assert world._trees is not None
        context.publish(MISSION_STATE, world.outputs.state.model_copy(update={"seq": ticks}))
        if ticks % 10 == 0:
            context.publish(TREES_LIST, world._trees.message)

    context.every_wall(_TICK_S, tick)


def main(port: int, uav: str) -> int:
    config = TreedockConfig(router=RouterConfig(port=port), uav=uav)
    return run_service("navigator", register, config)


if __name__ == "__main__":
    end_process(main(int(sys.argv[1]), sys.argv[2]))
