from __future__ import annotations

import numpy as np
import pytest

from schemas.topics import MAP_CLOUD, TREES_LIST
from schemas.trees import Tree, TreeList
from services.common.geometry import inverse, level_camera
from tests.unit.detector_clouds import Floats, facing, ground, trunk
from tests.unit.detector_world import EYE, System, moved, submap_of


def _forest(seed: int = 1) -> Floats:
    rng = np.random.default_rng(seed)
    trunks = [trunk(x, y, r, rng, arc=facing(x, y)) for x, y, r in ((3.0, 0.4, 0.10), (4.0, -1.5, 0.15))]
    return np.concatenate([ground(5.0), *trunks])


def test_trees_are_published_once_and_answered() -> None:
    system = System()
    system.send(submap_of(_forest()))
    (told,) = system.lists
    assert [(round(t.x_m), round(t.y_m, 1)) for t in told.trees] == [(3, 0.4), (4, -1.5)]
    assert told.graph_version == 3
    assert told.map_id == "m1"
    system.hub.advance_to(system.hub.clock.now_ns() + 2_000_000_000)
    assert len(system.lists) == 1, "nothing changed"
    assert system.hub.context("station").ask(TREES_LIST, None, TreeList, 1.0) == [told]
    assert [t.id for t in system.detector.final_trees()] == [1, 2]


def test_a_place_without_trees_gives_an_empty_list() -> None:
    system = System()
    system.send(submap_of(ground()))
    assert [told.trees for told in system.lists] == [()]
    assert system.detector.final_trees() == []


def test_ids_follow_a_movedsubmap_of() -> None:
    system = System()
    submap = submap_of(_forest())
    system.send(submap)
    before = {t.id: t for t in system.lists[-1].trees}
    turned = level_camera([0.0, 0.0, 1.5], 0.2)
    system.send(moved(submap, turned))
    after = {t.id: t for t in system.lists[-1].trees}
    assert after.keys() == before.keys()
    for tree_id, tree in before.items():
        x, y, _ = (turned @ inverse(EYE) @ [tree.x_m, tree.y_m, tree.z_m, 1.0])[:3]
        assert (after[tree_id].x_m, after[tree_id].y_m) == pytest.approx((x, y), abs=0.03)


def test_a_missed_delta_is_made_up_for() -> None:
    system = System()
    submap = submap_of(_forest())
    system.whole = [submap]
    system.send(moved(submap, EYE))  # a move of a submap never heard of
    assert len(system.lists[-1].trees) == 2
    assert system.detector._context.health.counters["map_queries"] == 1


def test_a_mapper_that_sends_little_in_time_is_asked_for_the_rest() -> None:
    system = System()
    system.whole = [submap_of(_forest(), submap_id=number) for number in range(1, 51)]
    system.at_once = 5
    system.tell_index(*system.whole)
    system.rest(3.0)
    assert system.detector._store.complete
    assert system.detector._context.health.counters["map_queries"] == 10, "each brought what was missing"


def test_a_mapper_that_does_not_answer_is_asked_ever_more_seldom() -> None:
    system = System()
    absent = [submap_of(_forest(), submap_id=number) for number in range(1, 4)]
    for _ in range(60):
        system.tell_index(*absent)
        system.rest(0.5)  # an index a second
    assert system.detector._context.health.counters["map_queries"] == 5  # after 0, 2, 6, 14 and 30 s
    system.whole = absent
    for _ in range(30):
        system.tell_index(*absent)
        system.rest(0.5)
    assert system.detector._store.complete


def test_withdrawn_and_new_maps() -> None:
    system = System()
    system.send(submap_of(_forest()))
    system.send(submap_of(ground(), map_id="m2"))
    assert system.lists[-1].map_id == "m2"
    assert len(system.lists[-1].trees) == 0
    system.send(submap_of(_forest(2), submap_id=2, map_id="m2"))
    newest: tuple[Tree, ...] = system.lists[-1].trees
    assert [t.id for t in newest] == [3, 4], "ids of an old map are not given again"


def test_a_map_that_changes_all_the_time_gives_at_most_five_lists_a_second() -> None:
    system = System()
    for tick in range(40):  # 20 changes a second for two seconds, each of them news: the trees move by 1 cm
        system.mapper.publish(MAP_CLOUD, submap_of(_forest() + np.array([0.01 * tick, 0.0, 0.0]), version=tick + 1))
        system.hub.run()
        system.hub.advance_to(system.hub.clock.now_ns() + 50_000_000)
    stamps = np.array([told.stamp_ns for told in system.lists]) * 1e-9
    assert 5 <= len(stamps) <= 11
    assert np.diff(stamps).min() >= 0.2 - 1e-6
