"""The setpoint that leans against gusts: how much, which way, never beyond the limits, and that it helps."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.navigation import Guidance, Setpoint
from services.navigator.config import DockConfig, NavigatorConfig
from services.navigator.telling import stiffened
from tests.contract.test_px4_bridge import Rig
from tests.unit.navigator_world import World


@pytest.mark.parametrize("stiffness", [0.0, 0.5])
def test_docked_and_pushed_away_it_leans_back(stiffness: float) -> None:
    dock = DockConfig(stiffness=stiffness)
    world = World(NavigatorConfig(dock=dock))
    world.start()
    assert world.run("dock") == "dock"
    world.run(seconds=2.0)
    b = world.mission.board
    off = np.array([0.1, -0.05, 0.03])
    world.position_m = world.position_m + off
    world.run(seconds=0.05)
    position, velocity = stiffened(b)
    assert b.here is not None
    error = b.trajectory.position_m - b.here.position_m
    lean = position - b.trajectory.position_m
    assert lean[:2] == pytest.approx(stiffness * error[:2], abs=0.03)
    assert lean[2] == 0.0
    assert np.linalg.norm(lean) <= 0.15 + 1e-9
    assert np.linalg.norm(velocity) <= 0.5
    assert world.outputs is not None
    s = world.outputs.guidance.setpoint
    assert s is not None
    assert s.position_m == pytest.approx(position)


class _Leaning(Rig):
    """Holds a place as the mission does when docked."""

    stiffness = 0.0

    def _guidance(self) -> Guidance:
        g, track = super()._guidance(), self.bridge.vision.track
        if track.latest is None or not self.mission:
            return g
        lean = self.stiffness * (np.array(self.goal) - track.predict(self.now_ns)[:3, 3])
        against = -self.stiffness * track.velocity_m_s
        lean[2] = against[2] = 0.0
        x, y, z = (float(v) for v in np.array(self.goal) + np.clip(lean, -0.15, 0.15))
        vx, vy, vz = (float(v) for v in np.clip(against, -0.15, 0.15))
        s = Setpoint(position_m=(x, y, z), yaw_rad=0.0, velocity_m_s=(vx, vy, vz), yaw_rate_rad_s=0.0)
        return g.model_copy(update={"setpoint": s})


@pytest.mark.slow
def test_gusts_move_it_less() -> None:
    strayed = []
    for stiffness in (0.0, 0.5):
        rig = _Leaning(1, 0.15)
        rig.stiffness = stiffness
        rig.run(3.0)
        rig.mission = 1
        rig.run(20.0)
        places = []
        for _ in range(100):
            rig.run(0.2)
            places.append(rig.T_map_camera()[:2, 3].copy())
        strayed.append(float(np.std(places, axis=0).max()))
    assert strayed[1] < 0.85 * strayed[0]
