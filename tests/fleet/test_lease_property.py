"""Whatever the link, the clocks (1 % wrong each way) and restarts do: never do two aircraft believe at the same true
time that they hold the same tree, or trees too near to each other; and when the link is well, somebody gets each tree."""

from __future__ import annotations

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from services.evaluate.fleet_link import LinkFaults
from tests.fleet.lease_net import STEP_NS, Net, goal

_RATE = st.sampled_from([0.99, 1.0, 1.01, 0.995])
_WHO = st.integers(0, 2)
_TREE = st.integers(0, 2)


class Leases(RuleBasedStateMachine):
    """Random wishes, cuts and restarts; ``Net.step`` checks the beliefs at every step of true time."""

    @initialize(seed=st.integers(0, 10_000), rates=st.tuples(_RATE, _RATE, _RATE, _RATE), memory=st.booleans())
    def begin(self, seed: int, rates: tuple[float, ...], memory: bool) -> None:
        self.net = Net(seed, rates)
        self.memory = memory
        self.pass_time(70)

    @rule(steps=st.integers(1, 120))
    def pass_time(self, steps: int) -> None:
        for _ in range(steps):
            self.net.pass_step()

    @rule(who=_WHO, tree=_TREE, again=st.booleans())
    def wish(self, who: int, tree: int, again: bool) -> None:
        self.net.fleet[who].holder.claim(goal(tree, by=0.1 * who), again=again)
        self.pass_time(10)

    @rule(who=_WHO)
    def done(self, who: int) -> None:
        self.net.fleet[who].holder.done()

    @rule(who=_WHO)
    def give_back(self, who: int) -> None:
        self.net.fleet[who].holder.release()

    @rule(who=_WHO)
    def aircraft_restarts(self, who: int) -> None:
        flying = self.net.fleet[who]
        flying.holder = type(flying.holder)(flying.holder.config, flying.holder.new_id)

    @rule(who=_WHO)
    def cut(self, who: int) -> None:
        self.net.cut ^= {self.net.fleet[who].name}

    @precondition(lambda self: self.net.alive)
    @rule()
    def arbiter_dies(self) -> None:
        self.net.alive = False

    @rule()
    def arbiter_starts(self) -> None:
        if not self.memory:
            self.net.disk = None
        self.net.start_arbiter(self.net.now_ns)
        self.pass_time(10)

    def teardown(self) -> None:
        """With a link that works each of three trees is given to one of those who ask for it, and to one only."""
        if not hasattr(self, "net"):
            return
        net = self.net
        net.cut, net.faults = set(), LinkFaults(0.0, STEP_NS)
        if not net.alive:
            net.start_arbiter(net.now_ns)
        for flying in net.fleet:
            flying.holder.release()
        self.pass_time(220)  # the longest delay, and a lease
        for who, flying in enumerate(net.fleet):
            flying.holder.claim(goal(1, by=0.1 * who), again=True)
        self.pass_time(20)
        assert sum(f.believes(net.now_ns) is not None for f in net.fleet) == 1


TestLeases = Leases.TestCase
TestLeases.settings = settings(
    max_examples=60, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True
)
