"""The supervisor's decisions, without processes."""

from __future__ import annotations

import itertools
import signal
import subprocess
from dataclasses import dataclass, field

from services.cli.run_config import SupervisorConfig
from services.cli.supervisor import Supervisor

LIMITS = SupervisorConfig(hung_after_s=5.0, start_within_s=60.0, backoff_s=0.5, backoff_max_s=3.0, give_up_after=4)


_LOOK_S = 0.5


@dataclass
class FakeProcess:
    pid: int
    code: int | None = None
    stubborn: bool = False
    undying: bool = False
    """Held by the kernel: not even a SIGKILL ends it at once."""
    signals: list[int] = field(default_factory=list)

    def poll(self) -> int | None:
        return self.code

    def send_signal(self, sig: int) -> None:
        self.signals.append(sig)
        if not self.undying and (sig == signal.SIGKILL or not self.stubborn):
            self.code = -sig

    def wait(self, timeout: float | None = None) -> int:
        if self.code is None:
            raise subprocess.TimeoutExpired("fake", timeout or 0.0)
        return self.code


class Bench:
    def __init__(self, *names: str, last: tuple[str, ...] = ()) -> None:
        self.now_s = 100.0
        self.spawned: list[FakeProcess] = []
        self.order: list[str] = []
        self.supervisor = Supervisor(names, self.spawn, LIMITS, frozenset(last), lambda: self.now_s)

    def spawn(self, name: str) -> FakeProcess:
        self.order.append(name)
        self.spawned.append(FakeProcess(1000 + len(self.spawned)))
        return self.spawned[-1]

    def after(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s - _LOOK_S:
            self.now_s += _LOOK_S
            self.supervisor.check()
        self.now_s = end_s
        self.supervisor.check()

    def ready(self, name: str) -> None:
        process = self.supervisor.children[name].process
        assert process is not None
        self.supervisor.heard(name, process.pid, "ready")


def test_all_start_in_order_and_are_ready_when_all_said_so() -> None:
    bench = Bench("router", "camera")
    bench.after(0.0)
    assert bench.order == ["router", "camera"]
    bench.ready("router")
    assert not bench.supervisor.all_ready
    bench.ready("camera")
    assert bench.supervisor.all_ready


def test_a_dead_service_comes_back_after_the_pause() -> None:
    bench = Bench("slam")
    bench.after(0.0)
    bench.ready("slam")
    bench.spawned[0].code = 1
    bench.after(0.1)
    assert len(bench.spawned) == 1
    bench.after(0.4)
    assert len(bench.spawned) == 1
    bench.after(0.2)
    assert len(bench.spawned) == 2
    assert bench.supervisor.restarts == 1


def test_the_pause_doubles_for_early_deaths_and_ends_in_giving_up() -> None:
    bench = Bench("slam")
    starts_s = []
    for _ in range(200):
        bench.after(0.1)
        if bench.spawned and bench.spawned[-1].code is None:
            starts_s.append(bench.now_s)
            bench.spawned[-1].code = 1
        if bench.supervisor.given_up:
            break
    pauses = [round(b - a, 1) for a, b in itertools.pairwise(starts_s)]
    assert pauses == sorted(pauses)
    assert pauses[0] < 1.0 < pauses[-1]
    assert bench.supervisor.given_up is bench.supervisor.children["slam"]
    assert len(starts_s) == LIMITS.give_up_after


def test_a_silent_service_is_killed_but_one_that_still_starts_is_not() -> None:
    bench = Bench("slam", "mapper")
    bench.after(0.0)
    bench.ready("slam")
    bench.after(6.0)
    assert bench.spawned[0].signals == [signal.SIGKILL]
    assert bench.spawned[1].signals == []
    bench.after(55.0)
    assert bench.spawned[1].signals == [signal.SIGKILL]


def test_health_of_a_replaced_process_counts_for_nothing() -> None:
    bench = Bench("slam")
    bench.after(0.0)
    bench.supervisor.heard("slam", 1, "ready")
    bench.supervisor.heard("unknown", 1, "ready")
    assert not bench.supervisor.all_ready


def test_bad_input_is_not_tried_again() -> None:
    bench = Bench("camera")
    bench.after(0.0)
    bench.spawned[0].code = 2
    bench.after(0.1)
    assert bench.supervisor.given_up is bench.supervisor.children["camera"]


def test_stop_asks_first_and_kills_then_and_the_router_goes_last() -> None:
    bench = Bench("router", "camera", "slam")
    bench.after(0.0)
    bench.spawned[2].stubborn = True
    bench.supervisor.stop_all()
    router, camera, slam = bench.spawned
    assert camera.signals == [signal.SIGTERM]
    assert slam.signals == [signal.SIGTERM, signal.SIGKILL]
    assert router.signals == [signal.SIGTERM]


def test_the_source_begins_when_all_others_are_ready_but_comes_back_at_once() -> None:
    bench = Bench("router", "camera", "slam", last=("camera",))
    bench.after(0.0)
    assert bench.order == ["router", "slam"]
    bench.ready("router")
    bench.after(1.0)
    assert bench.order == ["router", "slam"]
    bench.ready("slam")
    bench.after(1.0)
    assert bench.order == ["router", "slam", "camera"]
    bench.spawned[1].code = 1
    bench.spawned[2].code = 1
    bench.after(0.1)
    bench.after(2.0)
    assert sorted(bench.order[3:]) == ["camera", "slam"]


def silent_router(bench: Bench) -> FakeProcess:
    """All were ready; then the router hangs, and with it everybody's health; the others were heard a little earlier."""
    bench.after(0.0)
    for name in ("slam", "mapper"):
        bench.ready(name)
    bench.after(0.9)
    bench.ready("router")
    return bench.spawned[0]


def test_a_hung_router_is_not_taken_for_the_hanging_of_all() -> None:
    bench = Bench("router", "slam", "mapper")
    router = silent_router(bench)
    for _ in range(70):
        bench.after(0.1)
    assert router.signals == [signal.SIGKILL]
    assert [p.signals for p in bench.spawned[1:3]] == [[], []]
    bench.ready("router")
    for _ in range(45):
        bench.after(0.1)
    assert [p.signals for p in bench.spawned[1:3]] == [[], []], "they had no time to be heard again"
    for _ in range(10):
        bench.ready("router")
        bench.after(0.1)
    assert [p.signals for p in bench.spawned[1:3]] == [[signal.SIGKILL]] * 2, "now they hang themselves"


def test_a_configuration_damaged_in_flight_does_not_end_the_flight() -> None:
    bench = Bench("router", "navigator")
    bench.after(0.0)
    bench.ready("navigator")
    bench.spawned[1].code = -9
    bench.after(0.1)
    bench.after(0.6)
    bench.spawned[2].code = 2
    bench.after(0.1)
    assert bench.supervisor.given_up is None
    for _ in range(300):
        if bench.spawned[-1].code is None:
            bench.spawned[-1].code = 2
        bench.after(0.1)
    assert bench.supervisor.given_up is bench.supervisor.children["navigator"], "by then the aircraft has landed"


def test_no_flight_ends_because_the_recorder_cannot_be_had_back() -> None:
    bench = Bench("router", "recorder")
    bench.after(0.0)
    bench.ready("recorder")
    for _ in range(600):
        if len(bench.spawned) > 1 and bench.spawned[-1].code is None:
            bench.spawned[-1].code = 2
        bench.after(0.1)
    assert bench.supervisor.given_up is None
    assert len(bench.spawned) > LIMITS.give_up_after, "it is tried again and again"


def test_a_process_that_takes_long_to_die_is_killed_once() -> None:
    bench = Bench("slam")
    bench.after(0.0)
    bench.ready("slam")
    process = bench.spawned[0]
    process.undying = True
    for _ in range(70):
        bench.after(0.1)
    assert process.signals == [signal.SIGKILL]
    process.code = -9
    bench.after(0.1)
    bench.after(0.6)
    assert len(bench.spawned) == 2


def test_who_slept_takes_nobody_for_hung() -> None:
    """A machine that was suspended, or so busy that the supervisor itself stood still, kills nobody for it."""
    bench = Bench("slam")
    bench.after(0.0)
    bench.ready("slam")
    bench.after(3.0)
    bench.now_s += 60.0
    bench.supervisor.check()
    bench.after(1.5)
    assert not bench.spawned[0].signals
    bench.after(1.0)
    assert bench.spawned[0].signals == [signal.SIGKILL], "its own silence counts on"


def test_why_it_was_killed_is_kept_and_a_start_that_took_too_long_is_no_loss() -> None:
    bench = Bench("simulator")
    bench.after(LIMITS.start_within_s + 1.0)
    assert bench.spawned[0].signals == [signal.SIGKILL]
    bench.after(1.0)
    child = bench.supervisor.children["simulator"]
    assert child.last_fault == "was not ready after 60 s"
    bench.ready("simulator")
    assert not child.lost, "nobody had it yet"
    bench.after(6.0)
    bench.after(1.0)
    assert child.lost == child.last_fault == "was silent for 6 s"


def test_what_ended_by_itself_before_the_kill_reached_it_says_how() -> None:
    bench = Bench("camera")
    bench.after(0.0)
    bench.spawned[0].undying = True
    bench.after(LIMITS.start_within_s + 1.0)
    bench.spawned[0].code = 2
    bench.after(0.1)
    assert bench.supervisor.given_up is bench.supervisor.children["camera"]
    assert bench.supervisor.children["camera"].last_fault == "ended with exit code 2"
