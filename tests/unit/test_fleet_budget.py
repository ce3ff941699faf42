"""The arithmetic of docs/fleet.md is that of the topics table."""

from __future__ import annotations

import pytest

from schemas.topics import TOPICS, Reach
from services.evaluate import fleet_budget as budget
from services.station.config import StationConfig


def test_the_page_shows_the_arithmetic_as_it_is() -> None:
    page = budget.PAGE.read_text(encoding="utf-8")
    assert page == budget.spliced(page, budget.rendered()), "run: python -m services.evaluate.fleet_budget"


def test_every_topic_of_the_radio_is_counted() -> None:
    assert {t.name for t in TOPICS if t.reach is Reach.RADIO} == set(budget.USUAL)


def test_rates_are_those_behind_the_thinning_radio() -> None:
    pose = next(t for t in TOPICS if t.name == "slam/pose")
    assert budget.rate_hz(pose) == pose.radio_hz
    assert budget.bytes_per_s(pose) == pytest.approx(5 * (591 + 90))
    assert budget.thinned_bytes_per_s() < 0.2 * sum(budget.bytes_per_s(t) for t in budget.steady())


def test_a_station_as_it_comes_carries_a_cell_and_some_who_come_over() -> None:
    assert StationConfig().max_aircraft >= budget.CELL + 5
