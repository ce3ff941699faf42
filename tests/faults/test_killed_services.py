"""``kill -9`` in the approach, rendered, with real processes: what docs/safety.md says, in simulated time."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.mission.flights import Watched, flight

_KILL_S = 0.15
"""What is uncertain of the moment of the kill, in simulated time."""
_STILL_M_S = 0.12


def _in_approach(flown: Watched) -> None:
    assert flown.until(lambda: flown.state == "approach", 400.0), flown.state
    assert flown.flown_s(1.0)


@pytest.mark.slow
def test_slam_killed_holds_and_lands(tmp_path: Path) -> None:
    with flight(tmp_path, "--seed", "2") as flown:
        _in_approach(flown)
        killed_ns = flown.kill("slam")
        assert flown.until(lambda: flown.state == "hold", 30.0)
        assert (flown.states[-1].since_ns - killed_ns) * 1e-9 < 0.5 + _KILL_S
        assert flown.until(lambda: flown.guidance[-1].command == "stop", 5.0)
        # we land after pose_land_s, before PX4 leaves offboard by itself (EKF2_NOAID_TOUT)
        assert flown.until(lambda: flown.state in {"landing", "released"}, 60.0)
        assert (flown.states[-1].since_ns - killed_ns) * 1e-9 < 6.0
        code, values, err = flown.result()
    assert code == 3, err
    mission = values["mission"]
    assert mission["state"] in {"landed", "released"}
    assert not mission["docked"]
    assert not flown.vehicles[-1].armed
    assert mission["touches"] == 0


@pytest.mark.slow
def test_navigator_killed_holds_and_lands(tmp_path: Path) -> None:
    with flight(tmp_path, "--seed", "2") as flown:
        _in_approach(flown)
        killed_ns = flown.kill("navigator")
        assert flown.until(lambda: "holding" in flown.vehicles[-1].note, 30.0)
        assert (flown.vehicles[-1].stamp_ns - killed_ns) * 1e-9 < 0.5 + _KILL_S
        assert flown.flown_s(2.5)
        speeds = flown.speed_m_s(killed_ns)
        assert max(speed for at_s, speed in speeds if at_s < 0.3) > 0.15, "it was on its way"
        assert max(speed for at_s, speed in speeds if at_s > 1.8) < _STILL_M_S
        code, values, err = flown.result()
    assert code == 3, err
    assert not flown.vehicles[-1].armed
    assert values["mission"]["touches"] == 0
