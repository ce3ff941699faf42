"""The topics table is consistent, and ARCHITECTURE.md shows it as it is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from schemas.topics import TOPICS, Delivery, Reach, find
from services.evaluate.architecture import render_table, spliced

ROOT = Path(__file__).parents[2]


def test_keys_are_unique_and_plain() -> None:
    names = [topic.name for topic in TOPICS]
    assert len(set(names)) == len(names)
    for topic in TOPICS:
        assert re.fullmatch(r"[a-z_]+(/[a-z_*]+)?", topic.name)
        assert topic.key("uav1", "x").startswith("treedock/v1/uav1/")


def test_every_consumer_and_producer_is_a_process_of_the_design() -> None:
    known = {"camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot", "simulator", "station",
             "recorder", "preview", "evaluate", "*"}  # fmt: skip
    for topic in TOPICS:
        assert {topic.producer, *topic.consumers} <= known
        assert topic.producer not in topic.consumers


def test_truth_reaches_only_evaluation_and_stays_on_the_host() -> None:
    truth = find("sim/truth")
    assert truth.consumers == ("evaluate",)
    assert truth.reach is Reach.HOST


def test_radio_topics_are_small() -> None:
    for topic in TOPICS:
        if topic.reach is Reach.RADIO and topic.delivery is not Delivery.ADVANCED:
            assert topic.max_bytes <= 64 * 1024, topic.name


def test_a_timeout_leaves_room_for_the_rate() -> None:
    for topic in TOPICS:
        if topic.timeout_s is not None:
            assert topic.rate_hz > 0, topic.name
            assert topic.timeout_s >= 2.5 / topic.rate_hz, topic.name


def test_find_matches_leaves_and_names_the_choices() -> None:
    assert find("health/slam").name == "health/*"
    with pytest.raises(KeyError, match="slam/pose"):
        find("slam/posse")


def test_architecture_page_shows_the_table_as_it_is() -> None:
    page = (ROOT / "ARCHITECTURE.md").read_text()
    assert page == spliced(page, render_table()), "run: python -m services.evaluate.architecture"
