"""The topics table is consistent, and ARCHITECTURE.md shows it as it is."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from schemas import topics
from schemas.topics import TOPICS, Delivery, Reach, Topic, find
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
             "recorder", "preview", "evaluate", "router", "fusion", "second_camera", "second_slam", "*"}  # fmt: skip
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


_ROLES = {
    "camera": "camera", "slam": "slam", "mapper": "mapper", "detector": "detector", "detector/refine": "refiner", "router": "router",
    "navigator": "navigator", "navigator/autopilot": "autopilot", "preview": "preview", "simulator": "simulator", "fusion": "fusion",
}  # fmt: skip


def _heard(path: Path) -> set[str]:
    """Return the names of the topics that a service's file subscribes to: first arguments of ``.on(...)``."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "on" and node.args:
            found |= {n.id for n in ast.walk(node.args[0]) if isinstance(n, ast.Name)}
    return found


@pytest.mark.parametrize("folder", sorted(_ROLES))
def test_every_service_is_a_consumer_of_what_it_listens_to(folder: str) -> None:
    """Access control grants what the table says: a topic that is listened to without it is denied on an encrypted bus."""
    role = _ROLES[folder]
    for path in (ROOT / "services" / folder).glob("*.py"):
        for name in _heard(path):
            topic = getattr(topics, name, None)
            if isinstance(topic, Topic):
                assert role in topic.consumers or "*" in topic.consumers, f"{role} listens to {topic.name}"
