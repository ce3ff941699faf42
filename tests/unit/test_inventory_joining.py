"""Flights laid on each other: what was joined before moves along, and no trunk is counted twice."""

from __future__ import annotations

import numpy as np

from schemas.trees import Tree
from services.inventory.book import Inventory
from services.inventory.config import InventoryConfig
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
