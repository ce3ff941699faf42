"""Long random lives of three aircraft and an arbiter: the beliefs are checked at every step, and claims are granted."""

from __future__ import annotations

import random

import pytest

from tests.fleet.lease_net import Net, goal

_STEPS = 6_000
_RATES = (0.99, 1.01)


def live(seed: int, steps: int = _STEPS) -> Net:
    """Let everybody do anything for ``steps`` of true time; every second seed the arbiter loses its memory when it dies."""
    rng = random.Random(seed)
    net = Net(seed, tuple(rng.choice(_RATES) for _ in range(4)), loss=rng.choice((0.0, 0.1, 0.4)))
    down_until = 0
    for step in range(steps):
        who = rng.choice(net.fleet)
        act = rng.random()
        if act < 0.04:
            who.holder.claim(goal(rng.randrange(2), by=0.01 * rng.randrange(5)), again=True)
        elif act < 0.05:
            who.holder.release()
        elif act < 0.055:
            who.holder.withdraw()
        elif act < 0.06:
            who.holder.done()
        elif act < 0.062:
            who.holder = type(who.holder)(who.holder.config, who.holder.new_id)
        elif act < 0.07:
            net.cut ^= {who.name}
        elif act < 0.074 and net.alive:
            net.alive, down_until = False, step + rng.randrange(1, 30)
            net.disk = None if seed % 2 else net.disk
        if not net.alive and step >= down_until:
            net.start_arbiter(net.now_ns)
        net.pass_step()
    return net


@pytest.mark.parametrize("seed", range(12))
def test_no_two_ever_believe_in_the_same_tree(seed: int) -> None:
    assert live(seed).granted >= 5
