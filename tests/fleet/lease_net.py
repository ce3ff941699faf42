"""Three aircraft with clocks of their own and an arbiter behind a bad link; the beliefs are checked at every step."""

from __future__ import annotations

import itertools
import random
from dataclasses import dataclass

from schemas.fleet import ClaimGoal, ClaimReply
from services.evaluate.fleet_link import Clock, FleetLink, LinkFaults, Take
from services.fleet.config import ClaimConfig, FleetConfig
from services.fleet.holder import Asked, Holder
from services.fleet.shapes import Stretch

STEP_NS = 100_000_000
RULES = FleetConfig(enabled=True, lease_s=6.0, separation_m=3.0)
CLAIMS = ClaimConfig(enabled=True, renew_s=1.0, retry_s=0.5, reserve_s=2.0, hold_s=1.0)


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
    place = (spacing_m * tree, 0.0)
    return ClaimGoal(kind="tree", map_id="m", from_m=(spacing_m * tree, 4.0 + by), to_m=place, tree_id=tree)


class Net(FleetLink):
    """True time moves in steps; ``seed`` draws delays and losses."""

    def __init__(self, seed: int, rates: tuple[float, ...], loss: float = 0.2) -> None:
        rng = random.Random(seed)
        clock = Clock(rates[0], rng.randrange(10**12))
        super().__init__(RULES, LinkFaults(loss, 3_000_000_000), rng, clock, lambda _, g: Stretch(g.from_m, g.to_m))
        numbers = itertools.count(1)
        self.fleet = [
            Flying(f"uav{i}", Holder(CLAIMS, lambda: next(numbers)), Clock(rate, rng.randrange(10**12)))
            for i, rate in enumerate(rates[1:], 1)
        ]
        self.now_ns = self.granted = 0
        self.start_arbiter(0)

    def pass_step(self) -> None:
        self.now_ns += STEP_NS
        for flying in self.fleet:
            for asked in flying.holder.questions(flying.clock.at(self.now_ns)):
                self.send(flying.name, asked, self._taker(flying), self.now_ns)
        self.step(self.now_ns)
        self.check()

    def _taker(self, flying: Flying) -> Take:
        def take(asked: Asked, replies: list[ClaimReply]) -> None:
            before = flying.holder.held
            flying.holder.answered(asked, replies, flying.clock.at(self.now_ns))
            self.granted += flying.holder.held is not None and before is None

        return take

    def check(self) -> None:
        """At this true time no two believe in claims nearer to each other than the separation."""
        for a, b in itertools.combinations(self.fleet, 2):
            mine, theirs = a.believes(self.now_ns), b.believes(self.now_ns)
            if mine is not None and theirs is not None:
                gap = Stretch(mine.from_m, mine.to_m).gap_m(Stretch(theirs.from_m, theirs.to_m))
                assert gap >= RULES.separation_m, f"{a.name} and {b.name} both believe in {mine} and {theirs}"
