"""What is made of a fault's measurements: everything that must hold can fail."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from schemas.health import Health
from schemas.trees import TreeList
from services.evaluate.faults.chain import lost
from services.evaluate.faults.chain_rows import unsaid
from services.evaluate.faults.missions import Seen, line_of
from services.evaluate.faults.rig import Comeback
from services.evaluate.faults.verdict import Limits, common, faults_of, held_late, hold_within_s, summary
from tests.examples import all_messages

GOOD = Seen(
    what="kill -9 slam", state="approach", at_s=20.0, moved_m_s=0.3, noticed_s=0.0, back_s=2.0, ready_s=2.0, held_s=0.42, rest_s=1.0, way_m=0.3,
    end="landed", reason="slam is dead or hung", words=("slam is dead or hung",), touches=0, armings=1, starts=1,
    replays_refused=True, trees_lost=0, armed_after=False,
)  # fmt: skip


def test_what_holds_is_not_complained_of() -> None:
    assert list(faults_of("slam", GOOD, Limits())) == []


def test_an_aircraft_that_was_not_armed_yet_stays_on_the_ground_and_has_nothing_to_hold() -> None:
    seen = replace(GOOD, state="take_off", held_s=None, end="failed", reason="before take-off: no pose", flew=False)
    assert list(faults_of("fusion", seen, Limits())) == []
    assert list(faults_of("navigator", replace(seen, end="idle"), Limits())) == []


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"held_s": 0.9}, "held after 0.9"), ({"held_s": None}, "held after None"), ({"ready_s": 4.0}, "ready after 4.0"),
        ({"ready_s": None}, "ready after None"), ({"noticed_s": 20.0}, "noticed after 20.0"), ({"touches": 1}, "1 touches"),
        ({"armings": 2}, "armed 2 times"), ({"replays_refused": False}, "second time"), ({"trees_lost": 1}, "1 trees lost"),
        ({"reason": ""}, "without a reason"), ({"armed_after": True}, "armed"), ({"end": "hold"}, "neither went on nor ended"),
        ({"end": ""}, "no word"),
        ({"end": "idle"}, "neither went on nor ended"),
        ({"end": "idle", "bridge_landed": "no guidance: landing", "armed_after": True}, "neither went on nor ended"),
        ({"state": "take_off", "held_s": None, "end": "failed"}, "held after None"),
        ({"state": "take_off", "held_s": None, "flew": False}, "landed instead of failed"),
        ({"state": "take_off", "held_s": None, "flew": False, "end": "idle", "armed_after": True}, "neither went on nor ended"),
    ],
)  # fmt: skip
def test_whatever_does_not_hold_is_named(change: dict[str, object], word: str) -> None:
    found = list(faults_of("slam", replace(GOOD, **change), Limits()))  # type: ignore[arg-type]
    assert len(found) == 1
    assert word in found[0]


FLOWN_ON = replace(GOOD, state="scan", held_s=None, end="approach", reason="on")


@pytest.mark.parametrize("service", ["mapper", "detector", "recorder", "preview", "station", "second_slam", "router"])
def test_a_mission_that_does_not_need_the_service_goes_on(service: str) -> None:
    assert list(faults_of(service, FLOWN_ON, Limits())) == []
    docked = replace(FLOWN_ON, end="landed", reason="docked and back", docked=True)
    assert list(faults_of(service, docked, Limits())) == []
    assert list(faults_of(service, replace(FLOWN_ON, state="return", end="landed", reason="done"), Limits())) == []


def test_a_mission_that_ends_for_want_of_what_it_does_not_need_is_complained_of() -> None:
    ended = replace(FLOWN_ON, end="landed", reason="no way")
    held = replace(ended, holds=("detector is dead or hung",))
    assert "does not need recorder" in next(faults_of("recorder", held, Limits()))
    assert "never held before" in next(faults_of("detector", ended, Limits()))
    assert list(faults_of("detector", held, Limits())) == [], "away for long it holds, and lands"
    assert list(faults_of("refiner", replace(held, state="scan"), Limits())) == []


def test_a_hold_that_came_late_or_never_is_named() -> None:
    assert held_late(GOOD) == ""
    assert "after 0.9 s" in held_late(replace(GOOD, held_s=0.9))
    assert "after None s" in held_late(replace(GOOD, held_s=None))
    assert held_late(replace(GOOD, held_s=0.8), moment_s=0.35) == ""
    assert (
        held_late(replace(GOOD, held_s=None, state="landing"))
        == held_late(replace(GOOD, held_s=None, flew=False))
        == ""
    )


def test_a_loaded_machine_is_forgiven_what_it_made_wait_and_no_more() -> None:
    assert Comeback("slam", 0.0, 3.0, 1.0).ready_after_s() == 3.0
    assert Comeback("slam", 0.0, 9.0, 1.0, waited_s=6.0).ready_after_s() == 3.0
    assert Comeback("slam", 0.0, 9.0, 1.0, waited_s=0.5).ready_after_s() == 8.5, (
        "it slept, and nobody kept it from working"
    )
    assert Comeback("slam", 0.0, 9.0, 2.0, waited_s=30.0).ready_after_s() == 2.5, (
        "threads wait at once: never less than its own work"
    )


def test_a_tree_elsewhere_under_its_id_or_in_another_map_is_lost() -> None:
    before = all_messages()["treedock.trees"]
    assert isinstance(before, TreeList)
    assert before.trees
    assert lost(before, before) == []
    moved = before.trees[0].model_copy(update={"x_m": before.trees[0].x_m + 0.1})
    assert lost(before, before.model_copy(update={"trees": (moved, *before.trees[1:])})) == [before.trees[0].id]
    other = before.model_copy(update={"map_id": "another"})
    assert lost(before, other) == [t.id for t in before.trees]
    assert lost(before, other, anew=True) == []
    assert lost(before, other.model_copy(update={"trees": ()}), anew=True) == [t.id for t in before.trees]


def test_what_each_loss_asks_of_the_flight() -> None:
    assert hold_within_s("slam", "scan") == hold_within_s("navigator", "dock") == 0.5
    assert hold_within_s("refiner", "approach") == 0.5
    assert hold_within_s("refiner", "scan") is None
    assert hold_within_s("recorder", "approach") is None
    assert hold_within_s("slam", "landing") is None
    autopilot = hold_within_s("autopilot", "scan")
    assert autopilot is not None
    assert autopilot > 1.2


def test_a_mission_that_flies_on_is_well() -> None:
    assert list(common(replace(GOOD, end="approach", reason="on"))) == []
    assert list(common(replace(GOOD, end="landing", armed_after=True))) == []


def test_a_mission_that_the_bridge_ended_while_the_navigator_hung_is_well() -> None:
    """A hung navigator is noticed after 10 s; the bridge holds for 6 s and lands, and the new navigator knows no mission."""
    ended = replace(GOOD, end="idle", reason="waiting for a start command", bridge_landed="no guidance: landing")
    assert list(faults_of("navigator", ended, Limits())) == []


def test_a_landing_that_went_on_without_the_navigator_is_well() -> None:
    landed = replace(GOOD, state="landing", end="idle", reason="waiting for a start command", bridge_landed="")
    assert list(faults_of("navigator", landed, Limits())) == []
    assert list(faults_of("navigator", replace(landed, armed_after=True), Limits())) != []
    assert list(faults_of("navigator", replace(landed, state="approach"), Limits())) != []


def test_the_worst_of_several_counts() -> None:
    several = [GOOD, replace(GOOD, held_s=0.5, back_s=None), replace(GOOD, state="landing", held_s=9.0)]
    assert summary(several)["held_s"] == 0.5
    assert summary(several)["back_s"] == 2.0
    assert "never" in line_of(replace(GOOD, back_s=1e9))


def test_a_service_that_does_not_speak_of_its_damaged_map_is_complained_of() -> None:
    file = [Path("map-uav1.tdmap")]
    log = "12:00:00.000 mapper WARNING /x/map-uav1.tdmap: its header is damaged (checksum); the map begins anew\n"
    healthy = all_messages()["treedock.health"]
    assert isinstance(healthy, Health)
    counted = healthy.model_copy(update={"counters": {"bad_map_files": 1}})
    mute = healthy.model_copy(update={"counters": {}})
    assert unsaid(log, counted, file) == []
    assert unsaid(log.replace("WARNING", "INFO"), counted, file) == ["its log does not name map-uav1.tdmap"]
    assert unsaid("12:00:00.000 mapper INFO ready\n", mute, file) == [
        "its log does not name map-uav1.tdmap", "its health does not count the damaged map (bad_map_files)",
    ]  # fmt: skip
    assert unsaid(log, None, file) == ["its health does not count the damaged map (bad_map_files)"]
    assert unsaid(log, counted, []) == ["it had saved no map that could be damaged"]
