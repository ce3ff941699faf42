"""The mission as a user runs it: rendered, in real processes, to the end."""

from __future__ import annotations

from pathlib import Path

import pytest

from schemas.topics import TREES_TARGET
from tests.mission.flights import flight


@pytest.mark.slow
def test_a_rendered_mission_docks_although_the_refiner_is_killed_on_the_way(tmp_path: Path) -> None:
    """One flight for both, because it takes a minute or two.

    The refiner dies in the approach: the aircraft stops within half a second, the supervisor starts another refiner,
    the approach goes on, and the mission ends docked and landed.
    """
    with flight(tmp_path, "--seed", "1") as flown:
        assert flown.until(lambda: flown.state == "approach", 400.0), flown.state
        assert flown.flown_s(1.0)
        killed_ns = flown.kill("refiner")
        assert flown.until(lambda: flown.state == "hold", 30.0)
        assert (flown.states[-1].since_ns - killed_ns) * 1e-9 < 0.65  # 0.5 s, and 0.1 s for the moment of the kill
        assert flown.states[-1].failsafe in {"target lost", "service dead"}
        code, values, err = flown.result()
    assert code == 0, err
    mission = values["mission"]
    assert mission["state"] == "landed"
    assert values["restarts"] == {"refiner": 1}
    assert mission["touches"] == 0
    assert mission["clearance_m"] > 0.3
    dock = mission["docks"][0]
    assert 0.85 <= dock["true_distance_m"] <= 1.00
    assert abs(dock["true_heading_deg"]) <= 3.0
    assert abs(dock["distance_m"] - dock["true_distance_m"]) < 0.05
    assert values["truth"]["false"] == 0
    # nothing was lost on the way but the dead refiner's answers
    assert set(values["dropped"]) <= {*TREES_TARGET.consumers, "recorder"}, values["dropped"]
