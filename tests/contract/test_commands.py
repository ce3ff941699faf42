"""Commands: fresh by a nonce of the aircraft, in order, at most once; each refusal says why."""

from __future__ import annotations

from typing import Any, cast

import pytest

from schemas.command import Command, CommandReply, NonceReply, NonceRequest
from schemas.navigation import Guidance, MissionState
from schemas.topics import COMMAND, COMMAND_NONCE, MISSION_GUIDANCE, MISSION_STATE, Topic
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.memory import Hub, MemoryContext
from services.navigator.client import send_command
from services.navigator.commands import CommandDesk
from services.navigator.service import build

SECOND = 1_000_000_000


def _desk() -> CommandDesk:
    numbers = iter(range(1, 1000))
    return CommandDesk(5.0, lambda: next(numbers).to_bytes(16, "big"))


def _command(reply: NonceReply, sequence: int | None = None, **changes: Any) -> Command:
    values: dict[str, Any] = {"name": "hold", "sender": "ground", "nonce": reply.nonce}
    values["sequence"] = reply.next_sequence if sequence is None else sequence
    return Command(**{**values, **changes})


def test_fresh_command_is_taken_once() -> None:
    desk = _desk()
    fresh = desk.issue("ground", 0)
    command = _command(fresh)
    assert desk.refusal(command, SECOND) == ""
    assert "replayed" in desk.refusal(command, SECOND)
    assert desk.refusal(_command(fresh, fresh.next_sequence + 5), SECOND) == ""
    assert "replayed" in desk.refusal(_command(fresh, fresh.next_sequence + 5), SECOND)


def test_stale_unknown_and_stolen_nonces_are_refused() -> None:
    desk = _desk()
    fresh = desk.issue("ground", 0)
    assert "stale" in desk.refusal(_command(fresh), 5 * SECOND + 1)
    assert "unknown" in desk.refusal(_command(fresh, nonce=b"\0" * 16), 0)
    assert "another sender" in desk.refusal(_command(fresh, sender="other"), 0)
    assert desk.refusal(_command(fresh), 5 * SECOND) == ""


def test_a_command_recorded_in_an_earlier_exchange_is_worth_nothing() -> None:
    desk = _desk()
    old = _command(desk.issue("ground", 0))
    assert desk.refusal(old, 1) == ""
    desk.issue("ground", 4 * SECOND)
    assert desk.refusal(old, 4 * SECOND) != ""


def test_sequences_rise_over_all_nonces() -> None:
    desk = _desk()
    first = desk.issue("ground", 0)
    assert desk.refusal(_command(first, 41), 0) == ""
    assert desk.issue("ground", 0).next_sequence == 42


@pytest.mark.parametrize("sequence", [2**63 - 1, 1002])
def test_no_sender_can_use_up_the_numbers(sequence: int) -> None:
    desk = _desk()
    fresh = desk.issue("ground", 0)
    assert "1000 above" in desk.refusal(_command(fresh, sequence), 0)
    assert desk.issue("other", 0).next_sequence == 1
    assert desk.refusal(_command(fresh), 0) == ""


def test_a_sequence_a_little_above_the_expected_one_is_taken() -> None:
    desk = _desk()
    assert desk.refusal(_command(desk.issue("ground", 0), 1001), 0) == ""


@pytest.mark.parametrize("stop", ["hold", "land", "abort"])
def test_a_stop_has_the_last_word_over_what_was_on_its_way(stop: str) -> None:
    desk = _desk()
    slow, quick = desk.issue("ground", 0), desk.issue("ground", 0)
    assert desk.refusal(_command(quick, name=stop), 1) == ""
    assert "overtaken" in desk.refusal(_command(slow, name="resume"), 2)
    assert desk.refusal(_command(slow, name="land"), 2) == "", "another stop is never too late"
    assert desk.refusal(_command(desk.issue("ground", 3), name="resume"), 3) == "", "said after it, it counts"


def test_many_nonces_neither_grow_memory_nor_evict_other_senders_fresh_ones() -> None:
    desk = _desk()
    mine = desk.issue("ground", 0)
    for _ in range(500):
        desk.issue("flood", 0)
    assert desk.refusal(_command(mine), 0) == ""


@pytest.fixture
def hub() -> Hub:
    hub = Hub(TreedockConfig())
    hub.clock.set_ns(SECOND)
    build(cast("Context", hub.context("navigator")))
    return hub


def test_the_navigator_answers_with_its_reason(hub: Hub) -> None:
    client = hub.context("station")
    reply = send_command(client, "start")
    assert reply is not None
    assert not reply.accepted
    assert "autopilot" in reply.reason
    reply = send_command(client, "land")
    assert reply is not None
    assert not reply.accepted
    assert reply.state == "idle"


def test_a_clock_that_is_set_back_makes_no_old_command_fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    hub = Hub(TreedockConfig())
    hub.clock.set_ns(7_200 * SECOND)
    navigator = hub.context("navigator")
    steady_s = [100.0]
    monkeypatch.setattr(navigator, "steady_ns", lambda: round(steady_s[0] * SECOND))
    build(cast("Context", navigator))
    client = hub.context("station")
    old = client.ask(COMMAND_NONCE, NonceRequest(sender="ground"), NonceReply, 1.0)[0]
    hub.clock.set_ns(3_600 * SECOND)
    steady_s[0] += 11.0
    reply = client.ask(COMMAND, _command(old, name="land"), CommandReply, 1.0, leaf="land")[0]
    assert reply.reason.startswith("stale")


class TwoNavigators:
    """Two desks that answer the same keys, as when a navigator runs on two machines."""

    def __init__(self) -> None:
        self.desks = (_desk(), CommandDesk(10.0, lambda: b"another's nonce!"))
        self.taken: list[tuple[int, str]] = []

    def ask(self, topic: Topic, request: Any, kind: type[Any], timeout_s: float, leaf: str | None = None) -> list[Any]:
        del topic, kind, timeout_s, leaf
        if isinstance(request, NonceRequest):
            return [desk.issue(request.sender, 0) for desk in self.desks]
        replies = []
        for number, desk in enumerate(self.desks):
            reason = desk.refusal(request, 0)
            if not reason:
                self.taken.append((number, request.name))
            replies.append(CommandReply(accepted=not reason, reason=reason or "done", state="idle"))
        return replies


def test_where_two_navigators_run_nothing_starts_and_both_are_told_to_hold() -> None:
    """One would carry out what the other one's answer calls refused."""
    two = TwoNavigators()
    reply = send_command(two, "start")
    assert reply is not None
    assert not reply.accepted
    assert "2 navigators" in reply.reason
    assert two.taken == []
    reply = send_command(two, "hold")
    assert reply is not None
    assert reply.accepted
    assert two.taken == [(0, "hold"), (1, "hold")]


def test_the_key_and_the_name_must_agree(hub: Hub) -> None:
    client: MemoryContext = hub.context("station")
    nonce = client.ask(COMMAND_NONCE, NonceRequest(sender="ground"), NonceReply, 1.0)[0]
    replies = client.ask(COMMAND, _command(nonce, name="land"), CommandReply, 1.0, leaf="hold")
    assert not replies[0].accepted
    assert "cmd/hold" in replies[0].reason


def test_guidance_and_state_flow_from_the_first_moment(hub: Hub) -> None:
    guidance: list[Guidance] = []
    states: list[MissionState] = []
    client = hub.context("station")
    client.on(MISSION_GUIDANCE, guidance.append)
    client.on(MISSION_STATE, states.append)
    hub.advance_to(3 * SECOND)
    assert len(guidance) == pytest.approx(40, abs=1)
    assert len(states) == pytest.approx(10, abs=1)
    assert not any(g.engage for g in guidance)
    assert states[-1].state == "idle"


def test_a_lost_answer_is_told_as_none() -> None:
    assert send_command(Hub(TreedockConfig()).context("station"), "hold") is None
