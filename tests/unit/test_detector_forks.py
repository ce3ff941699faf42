"""Which pairs of axes are the arms of one forked tree."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from services.detector.forks import Arm, find_forks
from services.detector.model import Ground

GROUND = Ground(-10.0, -10.0, 20.0, np.zeros((1, 1, 3)), seen=True, note="")
FORK_M = 0.6


def arm(lean: float, low_m: float, *, x_m: float = 2.0, radius_m: float = 0.1, bent: bool = False) -> Arm:
    """Return an arm that leaves (x_m, 0, FORK_M) at a slope, seen from a height."""
    axis = np.array([lean, 0.0, 1.0]) / np.hypot(lean, 1.0)
    at = np.array([x_m + lean * (2.0 - FORK_M), 0.0, 2.0])
    return Arm(at, axis, radius_m, low_m, 3.0, bent)


def heights(arms: list[Arm], sure: int) -> list[float]:
    return [round(fork.height_m, 2) for fork in find_forks(arms, sure, GROUND)]


def test_arms_that_meet_below_both_are_a_fork() -> None:
    assert heights([arm(0.2, 0.7), arm(-0.2, 0.8)], 2) == [FORK_M]


def test_a_trunk_whose_fit_took_the_stem_along_is_an_arm_all_the_same() -> None:
    pair = [arm(0.2, 0.3), arm(-0.2, 1.9)]
    higher = [dataclasses.replace(a, at_m=a.at_m + np.array([0.0, 0.0, 0.6])) for a in pair]
    assert heights(higher, 2) == [1.2]
    assert heights(higher, 1) == [], "what is no trunk by itself tells a fork only below both"


def test_trees_that_lean_apart_from_places_of_their_own_are_none() -> None:
    assert heights([arm(0.2, 0.3, x_m=2.3), arm(-0.2, 0.3, x_m=1.7)], 2) == []


@pytest.mark.parametrize(("trunk_low_m", "found"), [(0.8, [FORK_M]), (0.3, [])])
def test_a_bent_line_is_an_arm_where_the_stem_is_hidden_and_a_bush_where_it_is_seen(
    trunk_low_m: float, found: list[float]
) -> None:
    assert heights([arm(0.2, trunk_low_m), arm(-0.3, 1.0, bent=True)], 1) == found


def test_a_bent_line_that_meets_the_trunk_where_it_is_seen_is_a_bush() -> None:
    assert heights([arm(0.2, 0.65), arm(-0.3, 1.0, bent=True)], 1) == []
