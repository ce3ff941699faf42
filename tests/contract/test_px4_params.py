"""Design section 7: parameters and their bytewise integers on the wire."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as m

from services.common.errors import InputError
from services.simulator.px4.params import INT32, NAMES, REAL32, VISION_SET, Parameters, integer_from_wire
from tests.contract.px4_companion import Companion, quiet


def as_wire(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def set_param(c: Companion, name: str, kind: int, field: float) -> None:
    c.send(m.MAVLink_param_set_message(1, 1, name.encode(), field, kind))
    c.run(0.05)


def test_integers_travel_bytewise() -> None:
    c = Companion(quiet())
    set_param(c, "EKF2_NOAID_TOUT", INT32, as_wire(1_500_000))
    assert c.px4.vehicle.params.integer("EKF2_NOAID_TOUT") == 1_500_000
    told = c.got["PARAM_VALUE"][-1][1]
    assert told.param_id == "EKF2_NOAID_TOUT"
    assert told.param_type == INT32
    assert integer_from_wire(told.param_value) == 1_500_000


def test_an_integer_sent_as_a_plain_float_is_not_what_was_meant() -> None:
    c = Companion(quiet())
    set_param(c, "COM_OBL_RC_ACT", INT32, 5.0)
    assert c.px4.vehicle.params.integer("COM_OBL_RC_ACT") == struct.unpack("<i", struct.pack("<f", 5.0))[0]
    set_param(c, "COM_OBL_RC_ACT", REAL32, 5.0)
    assert c.px4.counters["params_refused"] == 1


def test_reals_are_plain_and_nan_is_refused() -> None:
    c = Companion(quiet())
    set_param(c, "EKF2_EVP_NOISE", REAL32, 0.03)
    assert c.px4.vehicle.params["EKF2_EVP_NOISE"] == pytest.approx(0.03)
    set_param(c, "EKF2_EVP_NOISE", REAL32, float("nan"))
    assert c.px4.vehicle.params["EKF2_EVP_NOISE"] == pytest.approx(0.03)


def test_list_and_read_tell_every_parameter() -> None:
    c = Companion(quiet())
    c.send(m.MAVLink_param_request_list_message(1, 1))
    c.run(1.0)
    told = {p.param_id: p for _, p in c.got["PARAM_VALUE"]}
    assert sorted(told) == list(NAMES)
    assert all(p.param_count == len(NAMES) for p in told.values())
    c.send(m.MAVLink_param_request_read_message(1, 1, b"NAV_DLL_ACT", -1))
    c.run(0.05)
    assert c.got["PARAM_VALUE"][-1][1].param_id == "NAV_DLL_ACT"
    c.send(m.MAVLink_param_request_read_message(1, 1, b"", 3))
    c.run(0.05)
    assert c.got["PARAM_VALUE"][-1][1].param_index == 3


def test_the_vision_set_is_what_the_design_says() -> None:
    p = Parameters()
    expected = {
        "EKF2_EV_CTRL": 11, "EKF2_HGT_REF": 3, "EKF2_GPS_CTRL": 0, "SYS_HAS_GPS": 0, "EKF2_MAG_TYPE": 5,
        "SYS_HAS_MAG": 0, "COM_RC_IN_MODE": 4, "COM_OBL_RC_ACT": 4, "EKF2_EVP_NOISE": 0.02, "EKF2_EVA_NOISE": 0.05,
        "EKF2_NOAID_TOUT": 1_000_000,
    }  # fmt: skip
    assert expected == VISION_SET
    assert p.integer("COM_ARM_WO_GPS") == 1
    assert p.integer("NAV_DLL_ACT") == 0


def test_unknown_parameters_are_silent_and_unknown_overrides_are_told() -> None:
    c = Companion(quiet())
    set_param(c, "NO_SUCH_PARAM", REAL32, 1.0)
    assert not c.got["PARAM_VALUE"]
    with pytest.raises(InputError, match="NO_SUCH"):
        Parameters({"NO_SUCH": 1.0})
    with pytest.raises(InputError, match="MPC_THR_HOVER"):
        Parameters({"MPC_THR_HOVER": 0.0})


def test_a_value_that_would_break_the_arithmetic_is_refused() -> None:
    c = Companion(quiet())
    set_param(c, "MPC_XY_P", REAL32, 0.0)
    assert c.got["PARAM_VALUE"][-1][1].param_value == pytest.approx(0.95)


@given(st.integers(min_value=-(2**31), max_value=2**31 - 1))
def test_every_integer_that_is_not_a_nan_pattern_survives(value: int) -> None:
    p = Parameters()
    field = as_wire(value)
    if math.isnan(field):  # NaN patterns cannot be told apart once they are floats
        return
    p.set("COM_OBL_RC_ACT", value)
    parameter = p.get("COM_OBL_RC_ACT")
    assert parameter is not None
    assert integer_from_wire(parameter.wire_value) == value
