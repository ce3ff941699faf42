"""The edges of a lease, one by one: clocks that drift, restarts with and without a memory, words that come late."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from schemas.fleet import ClaimGoal, ClaimReply, ClaimRequest
from services.fleet.book import Book, Memory
from services.fleet.config import ClaimConfig, FleetConfig
from services.fleet.holder import Asked, Holder
from services.fleet.shapes import Stretch
from tests.fleet.lease_net import goal

S = 1_000_000_000
LEASE_S = 30.0


class Desk:
    """A book and two holders; a question and its answer take no time unless the test says so."""

    def __init__(self, separation_m: float = 3.0) -> None:
        self.disk: Memory | None = Memory()
        self.rules = FleetConfig(enabled=True, lease_s=LEASE_S, separation_m=separation_m)
        self.restart(0)
        numbers = itertools.count(1)
        self.one, self.two = (Holder(ClaimConfig(enabled=True), lambda: next(numbers)) for _ in range(2))

    def restart(self, now_ns: int) -> None:
        self.book = Book(self.rules, "arbiter", self._remember)
        self.book.begin(self.disk, now_ns)

    def _remember(self, memory: Memory) -> None:
        self.disk = memory

    def judged(self, uav: str, request: ClaimRequest, now_ns: int) -> ClaimReply:
        g = request.goal
        return self.book.answer(uav, request, Stretch(g.from_m, g.to_m, g.sigma_m), now_ns)

    def talk(self, holder: Holder, now_ns: int, arbiter_ns: int | None = None) -> list[ClaimReply]:
        uav = "one" if holder is self.one else "two"
        replies = []
        for asked in holder.questions(now_ns):
            replies.append(self.judged(uav, asked.request, now_ns if arbiter_ns is None else arbiter_ns))
            holder.answered(asked, [replies[-1]], now_ns)
        return replies


def test_the_slow_clock_lets_go_before_the_fast_one_gives_away() -> None:
    """True time passes; the aircraft's clock runs 1 % slow, the arbiter's 1 % fast, and the link is cut after the grant."""
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.two.claim(goal(1))
    for true_ns in range(0, 40 * S, 10_000_000):
        believed = desk.one.left_s(round(0.99 * true_ns)) > 0.0
        desk.talk(desk.two, true_ns, arbiter_ns=round(1.01 * true_ns))
        if desk.two.asked is None and desk.two.held is None:
            desk.two.claim(goal(1))
        assert not (believed and desk.two.held is not None), true_ns
    assert desk.two.held is not None


def test_a_restart_with_its_book_keeps_what_was_granted_for_a_whole_lease() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.restart(20 * S)
    desk.two.claim(goal(1))
    assert [r.granted for r in desk.talk(desk.two, 49 * S)] == [False]
    desk.two.claim(goal(1))
    assert desk.talk(desk.two, 51 * S)[-1].granted


def test_a_renewal_goes_on_over_a_restart() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.restart(5 * S)
    assert [r.reason for r in desk.talk(desk.one, 6 * S)] == ["renewed"]
    assert desk.one.left_s(6 * S) == pytest.approx(0.97 * LEASE_S)


def test_a_restart_without_a_book_waits_for_a_lease_and_says_so() -> None:
    desk = Desk()
    desk.disk = None
    desk.restart(100 * S)
    desk.one.claim(goal(1))
    reply = desk.talk(desk.one, 110 * S)[0]
    assert not reply.granted
    assert not reply.final
    assert "grants again in 20 s" in reply.reason
    desk.one.claim(goal(1))
    assert desk.talk(desk.one, 131 * S)[-1].granted


def test_a_grant_that_cannot_be_written_is_none() -> None:
    desk = Desk()

    def full(_: Memory) -> None:
        raise OSError(28, "No space left on device")

    desk.book.remember = full
    desk.one.claim(goal(1))
    reply = desk.talk(desk.one, 0)[0]
    assert not reply.granted
    assert "No space left" in reply.reason
    assert not desk.book.leases


def test_trees_nearer_than_the_separation_are_not_claimed_by_two() -> None:
    desk = Desk(separation_m=3.0)
    desk.one.claim(goal(1, spacing_m=2.9))
    desk.talk(desk.one, 0)
    desk.two.claim(goal(2, spacing_m=2.9))
    assert "one is too near: its way to a tree passes here" in desk.talk(desk.two, 0)[0].reason
    desk.two.claim(goal(3, spacing_m=2.9))
    assert desk.talk(desk.two, S)[-1].granted


def test_ways_that_cross_are_not_claimed_by_two() -> None:
    desk = Desk()
    desk.one.claim(ClaimGoal(kind="tree", map_id="m", from_m=(-9.0, 0.0), to_m=(9.0, 0.0), tree_id=1))
    desk.talk(desk.one, 0)
    desk.two.claim(ClaimGoal(kind="tree", map_id="m", from_m=(0.0, -9.0), to_m=(0.0, 9.0), tree_id=2))
    assert "passes here" in desk.talk(desk.two, 0)[0].reason


def test_a_tree_done_is_kept_until_that_is_known_and_never_given_to_another() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.one.done()
    desk.one.release()
    first = desk.one.questions(S)
    assert [a.request.kind for a in first] == ["done"], "the release must not overtake it"
    assert desk.judged("two", ClaimRequest(kind="claim", lease_id=90, goal=goal(1)), S).reason == "one holds this tree"
    desk.talk(desk.one, 3 * S)
    desk.talk(desk.one, 4 * S)
    desk.two.claim(goal(1, by=0.2))
    reply = desk.talk(desk.two, 5 * S)[0]
    assert reply.final
    assert "one has docked at this tree" in reply.reason
    desk.two.claim(goal(1), again=True)
    assert desk.talk(desk.two, 6 * S)[-1].granted, "the operator's word"


def test_visited_trees_outlive_a_restart() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.one.done()
    desk.talk(desk.one, S)
    desk.one.release()
    desk.talk(desk.one, 2 * S)
    desk.restart(3 * S)
    desk.two.claim(goal(1))
    assert desk.talk(desk.two, 40 * S)[0].final


def test_a_late_grant_of_a_withdrawn_claim_is_not_believed() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    asked = desk.one.questions(0)[0]
    reply = desk.judged("one", asked.request, 0)
    desk.one.claim(goal(2))
    desk.one.answered(asked, [reply], S)
    assert desk.one.held is None


def test_a_grant_that_took_longer_than_the_lease_is_not_believed() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    asked = desk.one.questions(0)[0]
    desk.one.answered(asked, [desk.judged("one", asked.request, 0)], 30 * S)
    assert desk.one.held is None


def test_two_arbiters_are_believed_by_nobody() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    asked = desk.one.questions(0)[0]
    reply = desk.judged("one", asked.request, 0)
    desk.one.answered(asked, [reply, reply.model_copy(update={"arbiter": "another"})], 0)
    assert desk.one.held is None
    assert "two arbiters answer (another, arbiter)" in desk.one.note


def test_two_arbiters_of_one_name_are_believed_by_nobody() -> None:
    """A book that was copied to a second station carries the name: the first answer was taken."""
    desk = Desk()
    desk.one.claim(goal(1))
    asked = desk.one.questions(0)[0]
    reply = desk.judged("one", asked.request, 0)
    desk.one.answered(asked, [reply, reply.model_copy(update={"granted": False, "lease_s": 0.0})], 0)
    assert desk.one.held is None
    assert "two arbiters answer (arbiter, arbiter)" in desk.one.note


def test_a_refused_renewal_is_told_and_not_repeated() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.book.leases.clear()
    desk.talk(desk.one, 4 * S)
    assert desk.one.held is not None
    assert "not known here" in desk.one.held.refused
    assert desk.one.questions(8 * S) == []


def test_a_map_that_moved_is_judged_anew() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    desk.two.claim(goal(2))
    desk.talk(desk.two, 0)
    desk.one.at((10.0, 3.0), (18.0, 0.0), "m")
    assert "the map moved: two is too near" in desk.talk(desk.one, 4 * S)[0].reason


def test_a_way_shrinks_as_it_is_flown_and_never_grows() -> None:
    desk = Desk()
    desk.one.claim(goal(1))
    desk.talk(desk.one, 0)
    for at in ((10.3, 2.6), (10.0, 3.9)):
        desk.judged("one", ClaimRequest(kind="renew", lease_id=1, goal=goal(1).model_copy(update={"from_m": at})), S)
    assert desk.book.leases["one", 1].way.from_m == (10.0, 2.6)


def test_questions_are_repeated_only_after_a_while() -> None:
    holder = Holder(ClaimConfig(enabled=True), lambda: 5)
    holder.claim(goal(1))
    assert len(holder.questions(0)) == 1
    assert holder.questions(S // 2) == []
    again = holder.questions(S)
    assert again == [Asked(replace(again[0]).request, S)]
    holder.answered(again[0], [], 2 * S)
    assert holder.note == "the arbiter does not answer"


def test_an_aircraft_backs_off_from_its_trunk_within_its_own_claim() -> None:
    """The stretch shrank to where it had docked, for good: another's way was granted 2.2 m from where it came to stand."""
    desk = Desk()
    desk.one.claim(ClaimGoal(kind="tree", map_id="m", from_m=(0.0, 0.0), to_m=(10.0, 0.0), tree_id=1))
    desk.talk(desk.one, 0)
    desk.one.at((9.05, 0.0), None, "m")  # docked
    assert desk.talk(desk.one, 4 * S)[0].reason == "renewed"
    behind = ClaimGoal(kind="tree", map_id="m", from_m=(6.0, 4.0), to_m=(6.0, 0.0), tree_id=2)
    desk.two.claim(behind)  # 3.05 m behind the docked one, 2.2 m behind where it undocks to
    assert "one is too near" in desk.talk(desk.two, 5 * S)[0].reason
    desk.two.claim(behind.model_copy(update={"from_m": (4.9, 4.0), "to_m": (4.9, 0.0)}))
    assert desk.talk(desk.two, 6 * S)[-1].granted, "what lies farther back is free"


def test_a_way_that_was_claimed_shorter_than_the_keep_grows_by_nothing() -> None:
    way = Stretch((9.0, 0.0), (10.0, 0.0))
    assert way.ahead_of((9.5, 0.3), keep_m=2.0) == way
    assert way.ahead_of((9.5, 0.3)) == Stretch((9.5, 0.0), (10.0, 0.0))
