"""What the bridge says of the battery: what the autopilot told a moment ago, or that nobody knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mav

from tests.unit.autopilot_rig import Rig


def status(percent: int) -> mav.MAVLink_sys_status_message:
    return mav.MAVLink_sys_status_message(0, 0, 0, 0, 12000, 0, percent, 0, 0, 0, 0, 0, 0)


def battery(percent: int) -> mav.MAVLink_battery_status_message:
    return mav.MAVLink_battery_status_message(0, 1, 1, 2500, [3700] * 10, 900, 0, -1, percent)


@pytest.fixture
def rig() -> Rig:
    rig = Rig()
    rig.run(0.5)
    return rig


def share(rig: Rig) -> float | None:
    return rig.bridge.state(rig.now_ns).battery_share


@pytest.mark.parametrize("message", [status, battery])
def test_a_share_that_is_not_known_any_more_is_unknown_at_once(rig: Rig, message: Callable[[int], Any]) -> None:
    assert share(rig) is None
    rig._hear(message(60))
    assert share(rig) == pytest.approx(0.6)
    rig._hear(message(-1))
    assert share(rig) is None


@pytest.mark.parametrize("message", [status, battery])
def test_a_share_that_is_not_told_any_more_is_unknown_after_five_seconds(
    rig: Rig, message: Callable[[int], Any]
) -> None:
    rig._hear(message(60))
    rig.run(4.9)
    assert share(rig) == pytest.approx(0.6)
    rig.run(0.2)
    assert share(rig) is None
    rig._hear(message(58))
    assert share(rig) == pytest.approx(0.58)


def test_a_battery_beside_it_that_has_no_gauge_takes_nothing_away(rig: Rig) -> None:
    rig._hear(status(60))
    rig._hear(battery(-1))
    assert share(rig) == pytest.approx(0.6)


def test_where_the_system_status_does_not_know_the_battery_itself_may(rig: Rig) -> None:
    rig._hear(battery(60))
    rig._hear(status(-1))
    assert share(rig) == pytest.approx(0.6)


def test_an_autopilot_that_was_started_again_may_have_another_battery(rig: Rig) -> None:
    rig._hear(status(60))
    rig.telemetry = False
    rig.run(2.5)
    rig.telemetry = True
    rig.run(0.2)
    assert share(rig) is None
