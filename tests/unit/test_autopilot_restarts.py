"""An autopilot that starts late, again or as another: what the bridge asks anew, whom it believes, what it tells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mav

from services.navigator.autopilot.clock_check import ClockCheck
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.px4 import STREAMS_HZ
from services.navigator.autopilot.telemetry import Telemetry
from tests.unit.autopilot_rig import MS, POSITION_MODE, SECOND, Rig


def _from(message: Any, system: int = 1, component: int = 1) -> Any:
    message._header.srcSystem, message._header.srcComponent = system, component
    return message


def _heartbeat(system: int = 1) -> Any:
    return _from(mav.MAVLink_heartbeat_message(2, mav.MAV_AUTOPILOT_PX4, 1, 0, 4, 3), system)


def _requests(messages: list[Any], wanted: int) -> int:
    return sum(
        m.get_type() == "COMMAND_LONG" and m.command == mav.MAV_CMD_REQUEST_MESSAGE and m.param1 == wanted
        for m in messages
    )


def test_the_heartbeat_is_asked_for_one_by_one_while_flying_and_never_by_rate() -> None:
    rig = Rig()
    assert mav.MAVLINK_MSG_ID_HEARTBEAT not in STREAMS_HZ
    assert _requests(rig.run(2.0), mav.MAVLINK_MSG_ID_HEARTBEAT) == 0
    rig.engage()
    assert _requests(rig.run(2.0), mav.MAVLINK_MSG_ID_HEARTBEAT) == pytest.approx(20, abs=2)
    rig.mode = POSITION_MODE
    rig.run(0.2)
    assert rig.bridge.engagement.override
    assert _requests(rig.run(2.0), mav.MAVLINK_MSG_ID_HEARTBEAT) == 0


def test_an_origin_that_is_there_is_kept() -> None:
    rig = Rig()
    sent = rig.run(1.0)
    assert _requests(sent, mav.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) == 1
    rig.bridge.handle(_from(mav.MAVLink_gps_global_origin_message(1, 2, 3)), rig.now_ns)
    sent = rig.run(10.0)
    assert not any(m.get_type() == "SET_GPS_GLOBAL_ORIGIN" for m in sent)


def test_an_autopilot_started_again_is_asked_everything_again() -> None:
    rig = Rig(AutopilotConfig())
    rig.run(1.0)
    rig.bridge.handle(_from(mav.MAVLink_gps_global_origin_message(1, 2, 3)), rig.now_ns)
    rig.bridge.handle(_from(mav.MAVLink_param_value_message(b"NAV_DLL_ACT", 0.0, 6, 1, 0)), rig.now_ns)
    rig.run(2.0)
    assert rig.bridge.parameters.found == {"NAV_DLL_ACT": 0.0}
    rig.telemetry = False
    rig.run(3.0)
    rig.telemetry = True
    sent = rig.run(5.0)
    assert not rig.bridge.parameters.found
    assert sum(m.get_type() == "PARAM_REQUEST_READ" for m in sent) > 10
    assert any(m.get_type() == "SET_GPS_GLOBAL_ORIGIN" for m in sent)


def test_another_system_id_is_followed_after_a_silence_only() -> None:
    telemetry = Telemetry(191)
    assert telemetry.take(_heartbeat(1), SECOND)
    assert not telemetry.take(_heartbeat(7), 2 * SECOND)
    assert telemetry.system == 1
    assert not telemetry.take(_from(mav.MAVLink_extended_sys_state_message(0, 1), 7), 5 * SECOND)
    assert telemetry.take(_heartbeat(7), 5 * SECOND)
    assert telemetry.system == 7
    assert not telemetry.take(_heartbeat(1), 6 * SECOND)


@pytest.mark.parametrize(
    ("target", "result", "word"),
    [((0, 0), 1, "temporarily"), ((1, 191), 1, "temporarily"), ((255, 190), 1, ""), ((1, 191), 5, "")],
)
def test_only_our_own_acknowledgements_count_and_in_progress_is_no_refusal(
    target: tuple[int, int], result: int, word: str
) -> None:
    telemetry = Telemetry(191)
    telemetry.take(_heartbeat(), SECOND)
    telemetry.take(_from(mav.MAVLink_command_ack_message(400, result, 0, 0, *target)), SECOND)
    assert word in telemetry.arming_word
    assert bool(word) is bool(telemetry.arming_word)


def test_what_the_autopilot_says_of_a_refusal_is_told() -> None:
    telemetry = Telemetry(191)
    telemetry.take(_heartbeat(), SECOND)
    telemetry.take(_from(mav.MAVLink_statustext_message(2, b"Arming denied: heading estimate invalid")), SECOND)
    assert not telemetry.arming_word, "said, but not refused"
    telemetry.take(_from(mav.MAVLink_command_ack_message(400, 1, 0, 0, 1, 191)), SECOND)
    assert "heading estimate invalid" in telemetry.arming_word


def test_a_refusal_for_parameters_says_what_to_do() -> None:
    rig = Rig(AutopilotConfig())
    rig.run(15.0)
    assert "autopilot.set_parameters=true" in rig.bridge.refusal()
    assert "start the autopilot again" in rig.bridge.refusal()


@pytest.mark.parametrize(
    ("clock", "told"), [(lambda t: t // 2, True), (lambda t: t + t // 200, False), (lambda t: t, False)]
)
def test_a_simulated_autopilot_that_does_not_run_in_real_time_is_told(clock: Callable[[int], int], told: bool) -> None:
    check = ClockCheck()
    for second in range(1, 20):
        now_ns = second * SECOND
        for question in check.due(now_ns):
            check.take(mav.MAVLink_timesync_message(clock(now_ns + MS), question.ts1), now_ns + 2 * MS)
    assert ("times as fast" in check.word(20 * SECOND)) is told
