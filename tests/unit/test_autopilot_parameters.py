"""Parameters: what differs is told, bytewise integers are read right, sticks win on a real aircraft."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mav

from services.navigator.autopilot.parameters import (
    ParameterReader,
    VehicleKind,
    differences,
    read_value,
    refusals,
    setting,
    table,
    wanted,
)


def _good(kind: VehicleKind) -> dict[str, float]:
    return {p.name: p.value for p in wanted(kind)}


@pytest.mark.parametrize("kind", ["simulation", "real"])
def test_nothing_differs_when_all_is_as_it_has_to_be(kind: VehicleKind) -> None:
    assert not differences(_good(kind), kind)
    assert "REFUSED" not in table(_good(kind), kind)


def test_a_real_aircraft_with_the_simulations_parameters_is_refused() -> None:
    words = refusals(_good("simulation"), "real")
    assert any("COM_RC_IN_MODE" in w and "sticks" in w for w in words)
    assert any("COM_RC_OVERRIDE" in w and "no answer" in w for w in words)


def test_each_wrong_or_silent_parameter_is_named() -> None:
    for p in wanted("real"):
        found = _good("real")
        found[p.name] = p.value + 7.0
        assert [d.parameter.name for d in differences(found, "real")] == [p.name]
        del found[p.name]
        assert [d.found for d in differences(found, "real")] == [None]


def test_vision_with_velocity_does_as_well() -> None:
    assert not differences({**_good("real"), "EKF2_EV_CTRL": 15.0}, "real")


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_travel_bytewise(value: int) -> None:
    field = struct.unpack("<f", struct.pack("<i", value))[0]
    if field == field:  # a NaN's payload need not survive; PX4 has no such values
        assert read_value(field, mav.MAV_PARAM_TYPE_INT32) == value


def test_setting_is_read_back_as_it_was_meant() -> None:
    for p in wanted("simulation"):
        message: Any = setting(p, 1)
        assert read_value(message.param_value, message.param_type) == pytest.approx(p.value)


def test_the_reader_asks_until_all_have_answered_and_gives_up_on_the_silent() -> None:
    reader = ParameterReader("simulation")
    asked: set[str] = set()
    for i in range(200):
        for question in reader.due(1, i * 100_000_000):
            name = question.param_id.decode() if isinstance(question.param_id, bytes) else question.param_id
            asked.add(name)
            if name != "NAV_DLL_ACT":
                reader.take(name, 1.0, mav.MAV_PARAM_TYPE_REAL32)
    assert asked == {p.name for p in wanted("simulation")}
    assert reader.complete
    assert "NAV_DLL_ACT" not in reader.found
