"""The planned way beside the artificial potential field: on the scenes where a field gets stuck, and where it does not."""

from __future__ import annotations

import numpy as np
import pytest

from services.evaluate.bench_avoid import SCENES, Place, by_field, by_plan, meeting
from services.evaluate.potential import Field, velocity
from services.navigator.path import Disc


def test_the_field_draws_to_the_goal_and_pushes_off_surfaces() -> None:
    p, goal = np.zeros(2), np.array([4.0, 0.0])
    assert velocity(p, goal, [], Field()) == pytest.approx([0.35, 0.0])
    assert velocity(p, goal, [Disc(0.5, 0.0, 0.1)], Field())[0] < 0.0
    assert velocity(p, goal, [Disc(3.0, 0.0, 0.1)], Field()) == pytest.approx([0.35, 0.0])
    assert np.linalg.norm(velocity(p, goal, [Disc(0.1, 0.1, 0.1)], Field())) <= 0.35 + 1e-9


@pytest.mark.parametrize("name", ["trunk on the line", "pocket", "wall"])
def test_where_the_field_gets_stuck_the_planned_way_arrives(name: str) -> None:
    place = SCENES[name](np.random.default_rng([0, 1, 82]))
    planned, drawn = by_plan(place), by_field(place)
    assert planned.arrived
    assert planned.clearance_m > 0.7
    assert not drawn.arrived


def test_in_the_open_both_arrive() -> None:
    place = Place(np.array([4.0, 0.0]), (Disc(2.0, 1.8, 0.2),))
    assert by_plan(place).arrived
    assert by_field(place).arrived


def test_a_meeting_is_ahead_of_the_aircraft() -> None:
    for seed in range(12):
        case = meeting(seed)
        walker = case.walkers[0]
        times = np.linspace(0.0, 12.0, 200)
        tree = np.array([case.trunks[0].x_m, case.trunks[0].y_m])
        ahead = tree / np.linalg.norm(tree)
        gap = [float(np.hypot(*(np.array([walker.at(t).x_m, walker.at(t).y_m]) - 0.35 * t * ahead))) for t in times]
        assert min(gap[: int(np.argmax(times > walker.begin_s + 1.8 / walker.speed_m_s))]) > 0.6
