"""The model of the chain that benchmarks fly on: what it knew it does not forget."""

from __future__ import annotations

import numpy as np

from schemas.slam import Pose
from schemas.trees import TreeList
from services.common.geometry import level_camera
from services.evaluate.synthetic import ChainErrors, SyntheticChain, TrueTrunk

_STEP_NS = 100_000_000


def _after_turns(*turns_rad: float) -> tuple[list[Pose], list[TreeList]]:
    """Return what is said while the camera turns on the spot, to one side and to the other."""
    chain = SyntheticChain([TrueTrunk(3.0, 0.0, 0.1)], np.eye(4), ChainErrors(), np.random.default_rng(1))
    yaw, now_ns, poses, lists = 0.0, 0, [], []
    for turn in turns_rad:
        for _ in range(60):
            yaw, now_ns = yaw + turn / 60, now_ns + _STEP_NS
            chain.observe(level_camera(np.array([0.0, 0.0, 1.5]), yaw), now_ns)
            for message in chain.due(now_ns):
                poses += [message] if isinstance(message, Pose) else []
                lists += [message] if isinstance(message, TreeList) else []
    return poses, lists


def test_turning_back_neither_empties_the_list_nor_opens_the_loop_again() -> None:
    poses, lists = _after_turns(np.radians(380.0), np.radians(-300.0))
    counts = [len(told.trees) for told in lists]
    assert counts[0] == 0
    assert counts[-1] == 1
    assert counts == sorted(counts)
    resets = [told.reset_counter for told in poses]
    assert resets[-1] == 1
    assert resets == sorted(resets)


def test_a_chain_that_lists_at_once_does_so_whichever_way_it_turns_first() -> None:
    """A stand-in for a restarted detector: its list was empty while it had turned to the right."""
    chain = SyntheticChain(
        [TrueTrunk(3.0, 0.0, 0.1)], np.eye(4), ChainErrors(listed_after_rad=0.0), np.random.default_rng(1)
    )
    said = []
    for k in range(1, 60):
        chain.observe(level_camera(np.array([0.0, 0.0, 1.5]), -0.02 * k), k * _STEP_NS)
        said += [m for m in chain.due(k * _STEP_NS) if isinstance(m, TreeList)]
    assert len(said) > 2
    assert all(len(told.trees) == 1 for told in said)
