"""Flights laid on each other: what was joined before moves along, and no trunk is counted twice."""

from __future__ import annotations

import math

import numpy as np

from schemas.trees import Tree
from services.inventory.book import Inventory
from services.inventory.config import InventoryConfig
from tests.unit.navigator_world import tree
from tests.unit.test_inventory_merge import START, S, forest, listed, present, seen_from, take


def beyond(trees: list[Tree], x_m: float) -> list[Tree]:
    return [t.model_copy(update={"id": 100 + t.id, "x_m": t.x_m + x_m}) for t in trees]


def test_what_was_joined_to_a_flight_moves_along_when_it_is_laid_on_another_stand() -> None:
    """B alone left its site; trees that it shared with C became the mean of two frames, 17 of them beside every trunk."""
    book = Inventory(InventoryConfig())
    west, east = forest(21, 22), beyond(forest(22, 24), 22.0)
    take(book, "a", listed(west, map_id="a"), S)
    b = seen_from(east, 0.7, 20.0, 3.0, 1)
    take(book, "b", listed(b, map_id="b"), S)
    take(book, "c", listed(seen_from(east[:18], -1.2, 24.0, -2.0, 2), map_id="c"), S)
    assert [f.site for f in book.flights.values()] == [1, 2, 2]
    book.written()
    later = [t.model_copy(update={"id": 50 + t.id}) for t in seen_from(west, 0.7, 20.0, 3.0, 3)]
    take(book, "b", listed([*b, *later], 2 * S, map_id="b"), 2 * S)
    assert [f.site for f in book.flights.values()] == [1, 1, 1]
    trunks = np.array([(t.x_m, t.y_m) for t in [*west, *east]])
    found = np.array([(t.x_m, t.y_m) for t in book.trees.values() if t.status == "present"])
    away = np.hypot(*(found[:, None] - trunks[None]).transpose(2, 0, 1)).min(axis=1)
    assert away.max() < 0.3, f"{(away > 0.3).sum()} trees stand beside every trunk"
    assert len(found) == len(trunks)
    assert {t.site for t in book.trees.values()} == {1}
    changes = book.written()
    assert {2, 3} <= changes.flights.keys()
    assert "laid on the inventory with flight 2" in book.flights[3].note


def test_flights_without_a_start_point_come_to_the_globe_together() -> None:
    book = Inventory(InventoryConfig(start_points=(START.model_copy(update={"uav": "a"}),)))
    world = forest(23, 20)
    take(book, "b", listed(seen_from(world, 0.4, 1.0, 1.0, 1), map_id="b"), S)
    take(book, "c", listed(seen_from(world, 2.0, -1.0, 0.5, 2), map_id="c"), S)
    assert {t.frame for t in book.trees.values()} == {"local"}
    take(book, "a", listed(world, map_id="a"), 2 * S)
    assert {f.frame for f in book.flights.values()} == {"global"}
    assert {t.frame for t in book.trees.values()} == {"global"}
    assert sorted(set(book.written().placed)) == sorted(t.fid for t in book.trees.values() if t.fid <= 40)
    assert len(present(book)) == len(world)
    assert all(book.trees[k].flights == 3 for k in present(book))
    assert not any("local" in f.note for f in book.flights.values())


SURE = InventoryConfig(start_points=(START.model_copy(update={"sigma_m": 0.05, "sigma_heading_deg": 0.3}),))
"""Good enough to join trees directly."""


def told(book: Inventory, map_id: str, *lists: list[Tree]) -> None:
    """Take a flight's lists, one a second."""
    for k, trees in enumerate(lists, start=1):
        book.take(map_id, listed(trees, k * S, map_id=map_id, version=k), k * S)


def test_a_trunk_that_its_flight_lists_under_another_id_stays_one_tree() -> None:
    book = Inventory(SURE)
    told(book, "m1", [tree(3, 4.0, 0.0)])
    told(book, "m2", [tree(7, 4.05, 0.0)], [], [tree(12, 4.06, 0.0)])
    assert present(book) == [1]
    assert book.trees[1].flights == 2
    assert {s.tree_id: s.present for s in book.of_flight[2].values()} == {7: False, 12: True}


def test_an_id_that_changes_from_one_list_to_the_next_makes_no_second_tree() -> None:
    book = Inventory(SURE)
    told(book, "m1", [tree(3, 4.0, 0.0)])
    told(book, "m2", [tree(7, 4.05, 0.0)], [tree(12, 4.06, 0.0)])
    assert present(book) == [1]


def test_an_id_that_comes_back_beside_the_one_that_took_its_tree_is_another_tree() -> None:
    """The list holds both, and trees of one flight are never joined with each other."""
    book = Inventory(SURE)
    told(book, "m1", [tree(3, 4.0, 0.0)])
    both = [tree(7, 4.25, 0.0), tree(12, 4.06, 0.0)]
    told(book, "m2", [tree(7, 4.05, 0.0)], [], [tree(12, 4.06, 0.0)], both)
    assert present(book) == [1, 2]
    assert {s.tree_id: s.tree for s in book.of_flight[2].values()} == {7: 2, 12: 1}
    assert [list(book.of_tree[k]) for k in (1, 2)] == [[1, 3], [2]]
    told(book, "m3", [tree(1, 4.02, 0.0), tree(2, 4.26, 0.0)])
    assert present(book) == [1, 2]


def test_a_ghost_nearer_than_the_tree_is_not_brought_back() -> None:
    book = Inventory(SURE)
    told(book, "m1", [tree(3, 4.0, 0.0), tree(8, 4.13, 0.0)], [tree(3, 4.0, 0.0)])
    told(book, "m2", [tree(1, 4.11, 0.0)])
    assert present(book) == [1]
    assert book.trees[1].flights == 2
    assert book.trees[2].status == "withdrawn"


def test_a_tree_that_no_list_holds_any_more_is_found_again_by_another_flight() -> None:
    book = Inventory(SURE)
    told(book, "m1", [tree(3, 4.0, 0.0)], [])
    told(book, "m2", [tree(1, 4.1, 0.0)])
    assert present(book) == [1]


def test_flights_are_joined_by_their_present_trees_not_by_ghosts() -> None:
    book = Inventory(InventoryConfig(start_points=(START,)))
    world = forest(24)

    def beside(by_m: float, first_id: int) -> list[Tree]:
        return [t.model_copy(update={"id": first_id + t.id, "x_m": t.x_m + by_m * math.cos(t.id), "y_m": t.y_m + by_m * math.sin(t.id)})
                for t in world]  # fmt: skip

    told(book, "m1", [*world, *beside(0.12, 50)], world)
    told(book, "m2", [*beside(0.09, 0), *beside(0.02, 50)], beside(0.09, 0))
    while book.join_next(3 * S):
        pass
    assert book.flights[2].aligned
    assert len(present(book)) == len(world)
    assert all(book.trees[k].flights == 2 for k in present(book))
