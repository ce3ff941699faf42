"""Who else is on the link, the two clocks, parameters that are set, signing: what a bridge notices and tells."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mav

from services.common.errors import InputError
from services.navigator.autopilot.clock_check import ClockCheck
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.link import Codec, MavlinkLink, read_secret
from services.navigator.autopilot.parameters import ParameterReader, read_value, wanted
from services.navigator.autopilot.service import Autopilot
from tests.unit.autopilot_rig import LAND_MODE, MS, POSITION_MODE, SECOND, Rig


def _from(message: Any, system: int, component: int) -> Any:
    message._header.srcSystem, message._header.srcComponent = system, component
    return message


def _setpoint_of(system: int = 1, component: int = 195) -> Any:
    return _from(
        mav.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0, 9.0, *([0.0] * 10)), system, component
    )


def _heartbeat_of(component: int) -> Any:
    return _from(mav.MAVLink_heartbeat_message(18, mav.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3), 1, component)


@pytest.mark.parametrize("others", [_setpoint_of(), _heartbeat_of(191)])
def test_another_at_the_controls_is_told_held_for_and_landed_from(others: Any) -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([0.5, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    assert rig.setpoints(0.5)[-1].x == pytest.approx(0.5)
    said: list[str] = []
    for _ in range(30):
        rig.bridge.handle(others, rig.now_ns)
        sent = rig.setpoints(0.1)
        said.append(rig.bridge.state(rig.now_ns).note)
    assert sent[-1].x == pytest.approx(0.0), "held where the aircraft is"
    assert "holding" in said[-1]
    assert "191" in said[-1] or "195" in said[-1]
    for _ in range(50):
        rig.bridge.handle(others, rig.now_ns)
        rig.run(0.1)
    assert rig.mode == LAND_MODE


def test_another_who_falls_silent_in_time_is_forgiven() -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([0.5, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    rig.bridge.handle(_setpoint_of(), rig.now_ns)
    assert rig.setpoints(1.0)[-1].x == pytest.approx(0.0)
    assert rig.setpoints(3.5)[-1].x == pytest.approx(0.5)
    assert "holding" not in rig.bridge.state(rig.now_ns).note


def test_what_ended_one_mission_does_not_keep_the_next_from_beginning() -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([0.5, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    for _ in range(90):
        elsewhere = mav.MAVLink_position_target_local_ned_message(0, 1, 0, 4.0, *([0.0] * 10))
        rig.bridge.handle(_from(elsewhere, 1, 1), rig.now_ns)
        rig.run(0.1)
    assert rig.mode == LAND_MODE
    assert "another source?" in rig.bridge.state(rig.now_ns).note
    rig.armed, rig.mode = False, POSITION_MODE
    rig.run(1.0)
    rig.engage(2)
    assert rig.bridge.engagement.phase == "engaged", rig.bridge.state(rig.now_ns).note


_OTHERS: list[dict[str, Any]] = [
    {"engage": False, "mission_id": 0}, {"engage": True, "mission_id": 9, "land": True},
    {"engage": True, "mission_id": 1, "land": True, "seq": 3},  # it was started in flight, and adopts what it finds
]  # fmt: skip


@pytest.mark.parametrize("other", _OTHERS)
def test_a_second_navigator_neither_steers_nor_stops_the_mission_that_is_flown(other: dict[str, Any]) -> None:
    rig = Rig()
    rig.engage()
    rig.setpoint = (np.array([0.5, 0.0, 1.0]), 0.0, np.zeros(3), 0.0)
    rig.run(0.2)
    own = rig.guidance
    for _ in range(200):
        rig.guidance = other
        rig.bridge.on_guidance(rig.guidance_message(), rig.now_ns)
        rig.guidance = own
        assert all(m.x == pytest.approx(0.5) for m in rig.setpoints(0.01))
    assert rig.bridge.engagement.of_others == 200
    assert "stop it" in rig.bridge.engagement.others_word(rig.now_ns)
    rig.run(3.5)
    assert rig.bridge.engagement.others_word(rig.now_ns) == ""


def test_another_mission_does_not_begin_while_the_flown_one_pauses() -> None:
    rig = Rig()
    rig.engage()
    own, other = rig.guidance, {"engage": True, "mission_id": 9}
    for ticks, guidance in ((60, other), (100, own)):
        for _ in range(ticks):
            rig.guidance = other
            rig.bridge.on_guidance(rig.guidance_message(), rig.now_ns)
            rig.guidance = own if guidance is own else None
            rig.tick()
        assert rig.bridge.engagement.mission_id == 1
        assert ("holding" in rig.bridge.state(rig.now_ns).note) == (guidance is other)
    assert rig.bridge.engagement.phase == "engaged"


def test_one_that_adopted_the_mission_is_heard_once_the_first_is_silent() -> None:
    rig = Rig()
    rig.engage()
    rig.guidance = None
    rig.run(0.1)
    again = {"engage": True, "mission_id": 1, "land": True}
    for k in range(100):
        rig.guidance = {**again, "seq": k + 1}
        rig.bridge.on_guidance(rig.guidance_message(), rig.now_ns)
        rig.guidance = None
        rig.run(0.05)
    assert rig.bridge.engagement.phase == "landing"


def test_a_navigator_that_was_started_again_is_heard_once_the_old_one_is_silent() -> None:
    rig = Rig()
    rig.engage()
    rig.guidance = {"engage": False, "mission_id": 0}
    rig.run(0.05)
    assert rig.bridge.engagement.usable(rig.now_ns) is not None
    rig.run(rig.bridge.config.guidance_stale_s + 0.1)
    assert rig.bridge.engagement.usable(rig.now_ns) is None
    assert "holding" in rig.bridge.state(rig.now_ns).note


def test_nobody_engages_beside_another() -> None:
    rig = Rig()
    rig.guidance = {"engage": False, "mission_id": 1}
    rig.run(1.5)
    rig.guidance = {"engage": True, "mission_id": 1}
    for _ in range(130):
        rig.bridge.handle(_setpoint_of(), rig.now_ns)
        rig.run(0.1)
    assert not rig.armed
    assert "setpoints too" in rig.bridge.engagement.note


@pytest.mark.parametrize(("x", "word"), [(3.0, "another source"), (0.0, "")])
def test_an_autopilot_that_flies_elsewhere_is_noticed(x: float, word: str) -> None:
    rig = Rig()
    rig.engage()
    for _ in range(20):
        target = mav.MAVLink_position_target_local_ned_message(0, 1, 0, x, 0.0, -1.0, *([0.0] * 8))
        rig.bridge.handle(_from(target, 1, 1), rig.now_ns)
        rig.run(0.1)
    assert word in rig.bridge.state(rig.now_ns).note
    assert ("holding" in rig.bridge.state(rig.now_ns).note) is bool(word)


def test_a_failsafe_of_px4_is_told_from_the_pilot() -> None:
    for status, word in ((mav.MAV_STATE_CRITICAL, "failsafe"), (mav.MAV_STATE_ACTIVE, "pilot")):
        rig = Rig()
        rig.engage()
        rig.telemetry = False
        rig.bridge.handle(_from(mav.MAVLink_heartbeat_message(2, 12, 129, POSITION_MODE, status, 3), 1, 1), rig.now_ns)
        rig.run(0.05)
        assert rig.bridge.engagement.override
        assert word in rig.bridge.engagement.note


def test_refused_arming_says_what_the_autopilot_answered() -> None:
    rig = Rig()
    rig.guidance = {"engage": False, "mission_id": 1}
    rig.run(1.5)
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.obedient = False
    rig.run(1.7)
    rig.mode = 6 << 16
    for _ in range(130):
        rig.bridge.handle(_from(mav.MAVLink_command_ack_message(400, 1), 1, 1), rig.now_ns)
        rig.run(0.1)
    assert "temporarily rejected" in rig.bridge.engagement.note


def test_the_origin_is_never_set_in_flight() -> None:
    rig = Rig()
    assert any(m.get_type() == "SET_GPS_GLOBAL_ORIGIN" for m in rig.run(5.0))
    rig.armed = True
    rig.run(0.2)
    assert not any(m.get_type() == "SET_GPS_GLOBAL_ORIGIN" for m in rig.run(6.0))


# -- clocks -------------------------------------------------------------------------------------------------------


def _answered(check: ClockCheck, now_ns: int, offset_ns: int, trip_ns: int) -> None:
    for question in check.due(now_ns):
        check.take(mav.MAVLink_timesync_message(now_ns + trip_ns // 2 + offset_ns, question.ts1), now_ns + trip_ns)


def test_the_clocks_are_measured_and_a_jump_is_told() -> None:
    check = ClockCheck()
    for second in range(10):
        _answered(check, second * SECOND, 42 * SECOND, 2 * MS)
    assert check.offset_ns == pytest.approx(42 * SECOND, abs=1000)
    assert check.round_trip_ns == 2 * MS
    assert check.word(10 * SECOND) == ""
    _answered(check, 11 * SECOND, 43 * SECOND, 2 * MS)
    assert "jumped" in check.word(11 * SECOND)
    assert check.word(60 * SECOND) == ""


def test_a_slow_link_is_told() -> None:
    check = ClockCheck()
    for second in range(6):
        _answered(check, second * SECOND, 0, 15 * MS)
    assert "10 ms" in check.word(6 * SECOND)


# -- parameters ---------------------------------------------------------------------------------------------------


def _vehicle(
    reader: ParameterReader, values: dict[str, float], until_s: float, *, may_set: bool, from_s: float = 0.0
) -> list[str]:
    """Answer a reader as an autopilot does; return the names that were set."""
    changed = []
    for now_ns in range(round(from_s * SECOND), round(until_s * SECOND), 100 * MS):
        for message in reader.due(1, now_ns, may_set=may_set):
            name = message.param_id.decode() if isinstance(message.param_id, bytes) else message.param_id
            if message.get_type() == "PARAM_SET":
                changed.append(name)
                values[name] = read_value(message.param_value, message.param_type)
            if name in values:
                reader.take(name, values[name], mav.MAV_PARAM_TYPE_REAL32)
    return changed


def test_parameters_are_set_on_demand_only_those_that_differ_and_only_on_the_ground() -> None:
    values = {p.name: p.value for p in wanted("simulation")} | {"EKF2_EV_CTRL": 0.0, "COM_OBL_RC_ACT": 1.0}
    silent = ParameterReader("simulation")
    assert _vehicle(silent, dict(values), 5.0, may_set=True) == []
    reader = ParameterReader("simulation", change=True)
    assert _vehicle(reader, values, 5.0, may_set=False) == []
    assert sorted(_vehicle(reader, values, 10.0, may_set=True, from_s=5.0)) == ["COM_OBL_RC_ACT", "EKF2_EV_CTRL"]
    assert (values["EKF2_EV_CTRL"], values["COM_OBL_RC_ACT"]) == (11.0, 4.0)
    assert reader.changed == {"EKF2_EV_CTRL": 0.0, "COM_OBL_RC_ACT": 1.0}


def test_who_did_not_answer_at_boot_is_asked_again_later() -> None:
    reader = ParameterReader("simulation")
    values: dict[str, float] = {}
    _vehicle(reader, values, 4.0, may_set=False)
    assert reader.complete
    assert not reader.found
    for now_ns in range(4 * SECOND, 30 * SECOND, 100 * MS):
        for message in reader.due(1, now_ns):
            name = message.param_id.decode() if isinstance(message.param_id, bytes) else message.param_id
            reader.take(name, 1.0, mav.MAV_PARAM_TYPE_REAL32)
    assert len(reader.found) == len(wanted("simulation"))


def test_a_bridge_that_may_set_makes_the_vehicle_fit_to_fly() -> None:
    rig = Rig(AutopilotConfig(set_parameters=True))
    values = {p.name: p.value for p in wanted("simulation")} | {"COM_OBL_RC_ACT": 0.0}
    for _ in range(60):
        for message in rig.run(0.1):
            if message.get_type() not in ("PARAM_REQUEST_READ", "PARAM_SET"):
                continue
            name = message.param_id.decode() if isinstance(message.param_id, bytes) else message.param_id
            if message.get_type() == "PARAM_SET":
                values[name] = read_value(message.param_value, message.param_type)
            answer = mav.MAVLink_param_value_message(name.encode(), values[name], mav.MAV_PARAM_TYPE_REAL32, 1, 0)
            rig.bridge.handle(_from(answer, 1, 1), rig.now_ns)
    assert values["COM_OBL_RC_ACT"] == 4.0
    assert rig.bridge.refusal() == ""


# -- signing ------------------------------------------------------------------------------------------------------


def _heard(listener: Codec, data: bytes) -> int:
    return len(listener.take(data, lambda _: None))


def test_signed_messages_are_taken_and_unsigned_or_foreign_ones_are_not() -> None:
    beat = mav.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    ours, theirs = Codec(191, 1, lambda: 0, b"secret"), Codec(1, 1, lambda: 0, b"secret")
    assert _heard(ours, theirs.pack(beat)) == 1
    assert _heard(ours, Codec(1, 1, lambda: 0).pack(beat)) == 0
    assert _heard(ours, Codec(1, 1, lambda: 0, b"another").pack(beat)) == 0
    assert ours.bad_bytes == 2
    assert _heard(Codec(191, 1, lambda: 0), theirs.pack(beat)) == 1, "a listener without a secret takes all"


def test_a_recorded_signed_message_is_worth_nothing_later() -> None:
    beat = mav.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3)
    ours, theirs = Codec(191, 1, lambda: 0, b"secret"), Codec(1, 1, lambda: 0, b"secret")
    recorded = theirs.pack(beat)
    assert _heard(ours, recorded) == 1
    assert _heard(ours, recorded) == 0


def test_a_secret_that_cannot_be_read_is_told_in_one_line(tmp_path: Path) -> None:
    assert read_secret("") is None
    with pytest.raises(InputError, match="signing_key"):
        read_secret(str(tmp_path / "none"))
    (tmp_path / "empty").write_text("\n")
    with pytest.raises(InputError, match="empty"):
        read_secret(str(tmp_path / "empty"))
    (tmp_path / "key").write_text("secret\n")
    assert read_secret(str(tmp_path / "key")) == b"secret"


# -- the wire comes back ------------------------------------------------------------------------------------------


class _Dead:
    def read(self) -> bytes:
        raise ConnectionResetError("gone")

    def write(self, data: bytes) -> None:
        del data
        raise ConnectionResetError("gone")

    def close(self) -> None:
        self.closed = True


class _Alive(_Dead):
    def read(self) -> bytes:
        peer = mav.MAVLink(None, srcSystem=1, srcComponent=1)
        return bytes(mav.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(peer))


def test_a_wire_that_broke_is_opened_again() -> None:
    dead = _Dead()
    link = MavlinkLink(dead, Codec(191, 1, lambda: 0), _Alive)
    try:
        for _ in range(100):
            if link.poll():
                break
            link._stopped.wait(0.05)
        else:
            pytest.fail("the wire was not opened again")
        assert link.failed == ""
        assert dead.closed
    finally:
        link.close()


def test_the_table_of_parameters_that_differ_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    class Deaf:
        def poll(self) -> list[tuple[Any, int]]:
            return []

        def send(self, message: Any) -> None:
            del message

        def identify(self, system: int) -> None:
            del system

    context: Any = SimpleNamespace()
    service = Autopilot(context, AutopilotConfig(), Deaf())
    good = {p.name: p.value for p in wanted("simulation")}
    service.bridge.parameters.found = good | {"COM_OBL_RC_ACT": 0.0}
    service._tell_parameters()
    service._tell_parameters()
    assert caplog.text.count("| COM_OBL_RC_ACT | 4 | 0 | REFUSED |") == 1
    fine = Autopilot(context, AutopilotConfig(), Deaf())
    fine.bridge.parameters.found = good
    fine._tell_parameters()
    assert caplog.text.count("REFUSED") == 1
