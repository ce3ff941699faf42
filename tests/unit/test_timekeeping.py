"""One time for all machines: offsets from four stamps, corrections that neither jump nor run back."""

from __future__ import annotations

import time
from collections.abc import Sequence

import pytest

from schemas.health import Health
from schemas.timekeeping import ClockReply
from services.common.clock import WallClock, on_clock_ns
from services.common.clock_sync import ClockSync
from services.common.config import TreedockConfig
from services.common.context import HealthBook
from services.common.memory import Hub, MemoryContext
from services.common.timekeeping import KEPT, OffsetFilter, tell, told_ahead_s
from services.router.keeper import TimeKeeper

MS = 1_000_000
OFF_NS = 200 * MS


def test_the_quickest_exchange_counts() -> None:
    offsets = OffsetFilter()
    offsets.add(0, OFF_NS + 30 * MS, 40 * MS)  # 20 ms came late: its answer was 10 ms wrong
    offsets.add(100 * MS, OFF_NS + 101 * MS, 102 * MS)
    offsets.add(200 * MS, OFF_NS + 215 * MS, 260 * MS)
    assert offsets.offset_ns == OFF_NS


def test_less_than_the_measurements_own_error_is_no_offset() -> None:
    assert OffsetFilter().offset_ns is None
    offsets = OffsetFilter()
    offsets.add(0, 2 * MS, 6 * MS)
    assert offsets.offset_ns == 0
    offsets.forget()
    assert offsets.best is None


class Router:
    """Answers like the router, whose clock is ``ahead_ns`` ahead of this machine's."""

    def __init__(self, ahead_ns: int) -> None:
        self.clock, self.ahead_ns = WallClock(), ahead_ns
        self.there = True
        self.deaf_for = 0
        """Questions that it does not answer at first."""

    def ask(self, *_: object, **__: object) -> Sequence[ClockReply]:
        if self.deaf_for:
            self.deaf_for -= 1
            return []
        return [ClockReply(stamp_ns=self.clock.machine_ns() + self.ahead_ns)] if self.there else []


def test_a_service_starts_on_the_routers_time() -> None:
    wall = WallClock()
    router = Router(OFF_NS)
    ClockSync("slam", wall, router).begin()
    assert abs(wall.now_ns() - wall.machine_ns() - OFF_NS) < 5 * MS
    book = HealthBook()
    tell(wall, book)
    assert abs(book.counters["clock_behind_us"] - 200_000) < 5_000
    assert book.counters["clock_ahead_us"] == 0
    assert told_ahead_s(book.counters) == pytest.approx(-0.2, abs=0.005)
    assert told_ahead_s({}) is None, "an older service says nothing"


def test_without_an_answer_the_clock_is_left_alone() -> None:
    wall = WallClock()
    router = Router(OFF_NS)
    router.there = False
    ClockSync("slam", wall, router).begin()
    assert wall.correction_ns == 0


def test_a_router_that_answers_a_moment_later_is_waited_for() -> None:
    wall, router = WallClock(ahead_s=3600.0), Router(0)
    router.deaf_for = 3
    ClockSync("slam", wall, router).begin()
    assert abs(wall.correction_ns + 3600 * 10**9) < 5 * MS


def test_a_first_answer_that_comes_late_never_steps_a_working_service_by_hours() -> None:
    now_s = [100.0]
    wall, router = WallClock(), Router(-3600 * 10**9)
    router.there = False
    sync = ClockSync("navigator", wall, router, lambda: now_s[0])
    sync.begin()
    router.there = True
    now_s[0] += 62.0
    for _ in range(3):
        sync.once()
        assert wall.correction_ns == 0
        assert "3600.0 s" in sync.word
    router.ahead_ns = 0
    for _ in range(KEPT):
        sync.once()
    assert sync.word == ""


def test_a_first_answer_that_comes_late_corrects_less_than_a_second() -> None:
    now_s = [100.0]
    wall, router = WallClock(), Router(OFF_NS)
    router.there = False
    sync = ClockSync("navigator", wall, router, lambda: now_s[0])
    sync.begin()
    router.there = True
    now_s[0] += 62.0
    sync.once()
    assert abs(wall.correction_ns - OFF_NS) < 5 * MS
    assert sync.word == ""


def test_a_router_that_does_not_tell_the_time_for_long_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    now_s = [100.0]
    router = Router(0)
    sync = ClockSync("slam", WallClock(), router, lambda: now_s[0])
    sync.begin()
    router.there = False

    def goes_on(seconds: int) -> list[str]:
        caplog.clear()
        for _ in range(seconds // 2):
            now_s[0] += 2.0
            sync.once()
        return [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]

    with caplog.at_level("INFO"):
        assert goes_on(28) == [], "one answer lost, or ten, are no fault: the clock goes on"
        told = goes_on(600)
        assert len(told) == 1
        assert "the router has not told the time for 30 s" in told[0]
        assert "is the machine too busy" in told[0]
        router.there = True
        assert goes_on(2) == []
        assert "again" in caplog.text
        router.there = False
        assert len(goes_on(40)) == 1


def test_a_later_offset_is_slewed_in_and_time_never_runs_back() -> None:
    wall = WallClock()
    wall.correct(-OFF_NS)
    last_ns, begin_ns = wall.now_ns(), time.monotonic_ns()
    for _ in range(200):
        now_ns = wall.now_ns()
        assert now_ns >= last_ns
        last_ns = now_ns
        time.sleep(1e-4)
    passed_ns = time.monotonic_ns() - begin_ns
    assert 0 < -wall.correction_ns <= passed_ns // 1000 + 1
    assert wall.correct(MS, at_once=True) > MS


def test_a_sensors_stamp_is_counted_by_the_services_clock() -> None:
    wall = WallClock(ahead_s=3600.0)
    off_ns = on_clock_ns(wall, time.time_ns()) - wall.now_ns()
    assert abs(off_ns) < 100 * MS


def health(stamp_ns: int, uptime_s: float, service: str = "slam") -> Health:
    return Health(service=service, stamp_ns=stamp_ns, seq=0, state="ready", pid=1, uptime_s=uptime_s, counters={},
                  rates_hz={}, work_ms={})  # fmt: skip


@pytest.fixture
def context() -> MemoryContext:
    return Hub(TreedockConfig()).context("router")


def test_a_router_started_again_takes_up_the_time_of_those_who_outlived_it(context: MemoryContext) -> None:
    wall = WallClock(ahead_s=3600.0)  # its machine's clock was set
    keeper = TimeKeeper(context, wall)
    theirs = WallClock()
    keeper.on_health(health(theirs.now_ns() + 7 * 3600 * 10**9, 0.2, "camera"))  # started after it: knows nothing
    keeper.on_health(health(theirs.now_ns(), 60.0))
    assert abs(wall.now_ns() - theirs.now_ns()) < 50 * MS
    taken_up_ns = wall.correction_ns
    keeper.on_health(health(theirs.now_ns() + 10**9, 60.0))  # one is enough
    assert wall.correction_ns == taken_up_ns


def test_the_way_of_a_message_is_no_reason_to_set_the_clock(context: MemoryContext) -> None:
    wall = WallClock()
    TimeKeeper(context, wall).on_health(health(wall.now_ns() - 15 * MS, 60.0))
    assert wall.correction_ns == 0
