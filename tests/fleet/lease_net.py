"""An arbiter and aircraft with clocks of their own, joined by a link that delays, loses, repeats and reorders."""

from __future__ import annotations

import itertools
import random
from dataclasses import dataclass, field

from schemas.fleet import ClaimGoal, ClaimReply
from services.fleet.book import Book, Memory
from services.fleet.config import ClaimConfig, FleetConfig
from services.fleet.holder import Asked, Holder
from services.fleet.shapes import Stretch

STEP_NS = 100_000_000
RULES = FleetConfig(enabled=True, lease_s=6.0, separation_m=3.0)
CLAIMS = ClaimConfig(enabled=True, renew_s=1.0, retry_s=0.5, reserve_s=2.0, hold_s=1.0)


@dataclass
class Clock:
    """Runs at ``rate`` times true time, from a zero of its own."""

    rate: float
    zero_ns: int

    def at(self, true_ns: int) -> int:
        return self.zero_ns + round(true_ns * self.rate)


@dataclass
class Flying:
    """An aircraft's holder and clock."""

    name: str
    holder: Holder
    clock: Clock

    def believes(self, true_ns: int) -> ClaimGoal | None:
        held = self.holder.held
        return held.goal if held is not None and self.holder.left_s(self.clock.at(true_ns)) > 0.0 else None


def goal(tree: int, spacing_m: float = 10.0, by: float = 0.0) -> ClaimGoal:
    """A tree of the line, approached from its side: ways of different trees do not meet."""
    return ClaimGoal(
        kind="tree", map_id="m", from_m=(spacing_m * tree, 4.0 + by), to_m=(spacing_m * tree, 0.0), tree_id=tree
    )


@dataclass
class Net:
    """True time moves in steps; ``seed`` draws delays and losses."""

    seed: int
    rates: tuple[float, ...]
    loss: float = 0.2
    most_delay_ns: int = 3_000_000_000
    now_ns: int = 0
    cut: set[str] = field(default_factory=set)
    """Aircraft that no message reaches or leaves."""
    alive: bool = True
    disk: Memory | None = None
    granted: int = 0

    def __post_init__(self) -> None:
        self.random = random.Random(self.seed)
        numbers = itertools.count(1)
        self.arbiter_clock = Clock(self.rates[0], self.random.randrange(10**12))
        self.fleet = [
            Flying(f"uav{i}", Holder(CLAIMS, lambda: next(numbers)), Clock(rate, self.random.randrange(10**12)))
            for i, rate in enumerate(self.rates[1:], 1)
        ]
        self._requests: list[tuple[int, Flying, Asked]] = []
        self._replies: list[tuple[int, Flying, Asked, ClaimReply]] = []
        self.start_arbiter()

    def start_arbiter(self) -> None:
        self.book = Book(RULES, "arbiter", self._remember)
        self.book.begin(self.disk, self.arbiter_clock.at(self.now_ns))
        self.alive = True

    def _remember(self, memory: Memory) -> None:
        self.disk = memory

    def step(self) -> None:
        self.now_ns += STEP_NS
        for flying in self.fleet:
            for asked in flying.holder.questions(flying.clock.at(self.now_ns)):
                self._send(flying, asked)
        for late in [m for m in self._requests if m[0] <= self.now_ns]:
            self._requests.remove(late)
            _, flying, asked = late
            if self.alive:
                g = asked.request.goal
                reply = self.book.answer(
                    flying.name, asked.request, Stretch(g.from_m, g.to_m), self.arbiter_clock.at(self.now_ns)
                )
                for delay in self._delays(flying):
                    self._replies.append((self.now_ns + delay, flying, asked, reply))
        for late_reply in [m for m in self._replies if m[0] <= self.now_ns]:
            self._replies.remove(late_reply)
            _, flying, asked, reply = late_reply
            before = flying.holder.held
            flying.holder.answered(asked, [reply], flying.clock.at(self.now_ns))
            self.granted += flying.holder.held is not None and flying.holder.held is not before and before is None
        self.check()

    def _send(self, flying: Flying, asked: Asked) -> None:
        for delay in self._delays(flying):
            self._requests.append((self.now_ns + delay, flying, asked))

    def _delays(self, flying: Flying) -> list[int]:
        """Nothing when it is lost, twice when it is repeated."""
        if flying.name in self.cut or self.random.random() < self.loss:
            return []
        times = 2 if self.random.random() < 0.1 else 1
        longest = self.most_delay_ns * (5 if self.random.random() < 0.1 else 1)
        return [self.random.randrange(longest + 1) for _ in range(times)]

    def check(self) -> None:
        """At this true time no two believe in claims nearer to each other than the separation."""
        for a, b in itertools.combinations(self.fleet, 2):
            mine, theirs = a.believes(self.now_ns), b.believes(self.now_ns)
            if mine is not None and theirs is not None:
                gap = Stretch(mine.from_m, mine.to_m).gap_m(Stretch(theirs.from_m, theirs.to_m))
                assert gap >= RULES.separation_m, f"{a.name} and {b.name} both believe in {mine} and {theirs}"
