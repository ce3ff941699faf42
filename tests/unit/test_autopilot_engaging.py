"""Who arms, and who takes his order back, while the bridge engages."""

from __future__ import annotations

import pytest

from tests.unit.autopilot_rig import LAND_MODE, POSITION_MODE, Rig


@pytest.mark.parametrize("after_s", [0.2, 1.0, 1.45])
def test_the_pilot_who_arms_while_engaging_has_the_aircraft(after_s: float) -> None:
    """In the mode in which his switch was all along: he means to fly, and offboard would take it from him."""
    rig = Rig()
    rig.mode = POSITION_MODE
    rig.run(2.0)
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.run(after_s)
    rig.armed = True
    rig.run(10.0)
    assert rig.mode == POSITION_MODE
    assert not rig.setpoints(2.0)
    assert rig.bridge.engagement.phase == "released"
    assert "armed, not by us" in rig.bridge.engagement.note


def test_an_order_taken_back_while_it_arms_lands_at_once() -> None:
    rig = Rig()
    rig.guidance = {"engage": False, "mission_id": 1}
    rig.run(1.5)
    rig.guidance = {"engage": True, "mission_id": 1}
    while "engaged" not in rig.bridge.engagement.note:
        rig.tick()
    rig.guidance = {"engage": False, "mission_id": 1}  # it has not heard yet that the vehicle is armed
    rig.run(0.5)
    assert rig.bridge.engagement.note == "the navigator took its order back: landing"
    assert rig.mode == LAND_MODE
