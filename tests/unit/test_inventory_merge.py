"""Trees of several flights become one inventory: links, history, joining by pattern, coordinates."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.trees import Tree, TreeList
from services.inventory.align import Prior, align
from services.inventory.book import Inventory
from services.inventory.config import InventoryConfig, StartPoint
from services.inventory.geodesy import TangentPlane, earth_from_geodetic, geodetic_from_earth, place_of_start
from services.inventory.merge import Spots, assign, belief_of, fuse
from services.inventory.values import Contents
from tests.unit.navigator_world import tree

S = 1_000_000_000
START = StartPoint(uav="*", latitude_deg=-43.52, longitude_deg=172.58, altitude_m=20.0, heading_deg=30.0)


def listed(trees: list[Tree], stamp_ns: int = S, map_id: str = "m1", version: int = 1) -> TreeList:
    return TreeList(stamp_ns=stamp_ns, map_id=map_id, version=version, graph_version=0, trees=tuple(trees))


def forest(seed: int, count: int = 14) -> list[Tree]:
    rng = np.random.default_rng(seed)
    found: list[Tree] = []
    while len(found) < count:
        x, y = rng.uniform(-9.0, 9.0, 2)
        if all(math.hypot(t.x_m - x, t.y_m - y) > 1.2 for t in found):
            found.append(tree(len(found) + 1, float(x), float(y), float(rng.uniform(0.05, 0.19))))
    return found


def seen_from(
    trees: list[Tree], yaw_rad: float, x_m: float, y_m: float, seed: int, noise_m: float = 0.03
) -> list[Tree]:
    """The same trees in the map of a flight that began at (x, y) and looked along yaw; numbered anew."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(trees))
    c, s = math.cos(-yaw_rad), math.sin(-yaw_rad)
    moved = []
    for number, k in enumerate(order, start=1):
        t, n = trees[int(k)], rng.normal(0.0, noise_m, 3)
        dx, dy = t.x_m - x_m + float(n[0]), t.y_m - y_m + float(n[1])
        moved.append(t.model_copy(update={
            "id": number, "x_m": c * dx - s * dy, "y_m": s * dx + c * dy, "radius_m": t.radius_m + float(n[2]) / 10.0,
            "sigma_xy_m": noise_m,
        }))  # fmt: skip
    return moved


def spots_of(trees: list[Tree]) -> Spots:
    return Spots.of([(t.x_m, t.y_m, t.radius_m, t.sigma_xy_m, t.sigma_radius_m) for t in trees])


def take(book: Inventory, uav: str, trees: TreeList, now_ns: int) -> None:
    """Take a list and join what can be joined."""
    book.take(uav, trees, now_ns)
    while book.join_next(now_ns):
        pass


def present(book: Inventory) -> list[int]:
    return sorted(t.fid for t in book.trees.values() if t.status == "present")


# -- coordinates


@given(st.floats(-89.9, 89.9), st.floats(-179.9, 179.9), st.floats(-100.0, 3000.0))
def test_earth_and_back_within_a_micrometre(latitude: float, longitude: float, altitude: float) -> None:
    back = geodetic_from_earth(earth_from_geodetic(latitude, longitude, altitude))
    assert back[0] == pytest.approx(latitude, abs=1e-11)
    assert back[1] == pytest.approx(longitude, abs=1e-10)
    assert back[2] == pytest.approx(altitude, abs=1e-6)


def test_known_point_of_the_ellipsoid() -> None:
    # a point of the standard's own kind: on the equator, at a pole, and one second of latitude
    assert earth_from_geodetic(0.0, 0.0, 0.0) == pytest.approx((6_378_137.0, 0.0, 0.0))
    assert earth_from_geodetic(90.0, 0.0, 0.0)[2] == pytest.approx(6_356_752.314245, abs=1e-6)
    plane = TangentPlane(45.0, 0.0)
    north = plane.from_geodetic(45.0 + 1.0 / 3600.0, 0.0, 0.0)[1]
    assert north == pytest.approx(30.870, abs=0.005)  # metres of a second of latitude at 45 degrees


def test_heading_turns_the_map_onto_the_compass() -> None:
    plane = TangentPlane(START.latitude_deg, START.longitude_deg)
    for heading, ahead in ((0.0, (0.0, 10.0)), (90.0, (10.0, 0.0)), (180.0, (0.0, -10.0)), (270.0, (-10.0, 0.0))):
        place = place_of_start(plane, START.latitude_deg, START.longitude_deg, 0.0, heading)
        east, north, _ = place.apply(10.0, 0.0, 0.0)
        assert (east, north) == pytest.approx(ahead, abs=1e-4)
        left = place.apply(0.0, 10.0, 0.0)[:2]
        assert left == pytest.approx((-ahead[1], ahead[0]), abs=1e-4)


# -- one flight


def test_a_flight_keeps_its_links_and_each_measurement_its_history() -> None:
    book = Inventory(InventoryConfig())
    trees = [tree(1, 4.0, 1.0), tree(2, 4.0, 2.0)]
    book.take("uav1", listed(trees), S)
    first = book.written()
    assert len(first.trees) == len(first.measurements) == 2
    moved = [trees[0].model_copy(update={"x_m": 4.05, "observations": 12}), trees[1]]
    book.take("uav1", listed(moved, 3 * S, version=2), 3 * S)
    second = book.written()
    assert [m.belief.x_m for m in second.measurements] == [4.05]
    assert present(book) == [1, 2]
    assert book.trees[1].x_m == pytest.approx(4.05)


def test_what_tells_nothing_new_is_not_written() -> None:
    book = Inventory(InventoryConfig())
    trees = [tree(k, float(k), 0.0) for k in range(1, 50)]
    book.take("uav1", listed(trees), S)
    book.written()
    book.take("uav1", listed(trees, 2 * S, version=2), 2 * S)
    changes = book.written()
    assert not changes.measurements
    assert not changes.sightings
    assert not changes.trees


def test_trees_of_one_flight_are_never_joined() -> None:
    book = Inventory(InventoryConfig())
    book.take("uav1", listed([tree(1, 4.0, 0.0), tree(2, 4.15, 0.0)]), S)
    assert present(book) == [1, 2]


def test_a_tree_that_left_the_list_is_withdrawn_and_comes_back() -> None:
    book = Inventory(InventoryConfig())
    both = [tree(1, 4.0, 0.0), tree(2, 6.0, 0.0)]
    book.take("uav1", listed(both), S)
    book.take("uav1", listed(both[:1], 2 * S), 2 * S)
    assert present(book) == [1]
    assert book.trees[2].status == "withdrawn"
    book.take("uav1", listed(both, 3 * S), 3 * S)
    assert present(book) == [1, 2]


def test_an_older_list_changes_nothing_and_time_that_ran_back_is_another_flight() -> None:
    book = Inventory(InventoryConfig())
    book.take("uav1", listed([tree(1, 4.0, 0.0)], 100 * S), S)
    book.take("uav1", listed([tree(1, 9.0, 0.0)], 99 * S), S)
    assert book.trees[1].x_m == 4.0
    book.take("uav1", listed([tree(1, 9.0, 0.0)], 10 * S), S)
    assert [f.run for f in book.flights.values()] == [1, 2]
    assert len(present(book)) == 2


def test_a_station_that_was_restarted_doubles_nothing() -> None:
    book = Inventory(InventoryConfig())
    trees = forest(3)
    book.take("uav1", listed(trees), S)
    again = Inventory(InventoryConfig(), Contents(tuple(book.sites.values()), tuple(book.flights.values()),
                                                  tuple(book.sightings.values()), tuple(book.trees.values())))  # fmt: skip
    again.take("uav1", listed(trees, 2 * S, version=2), 2 * S)
    assert present(again) == present(book)
    assert len(again.sightings) == len(book.sightings)


def test_rows_that_somebody_deleted_are_entered_anew() -> None:
    book = Inventory(InventoryConfig())
    book.take("uav1", listed([tree(1, 4.0, 0.0), tree(2, 6.0, 0.0)]), S)
    kept = tuple(t for t in book.trees.values() if t.fid != 1)
    again = Inventory(InventoryConfig(), Contents(tuple(book.sites.values()), tuple(book.flights.values()),
                                                  tuple(book.sightings.values()), kept))  # fmt: skip
    again.take("uav1", listed([tree(1, 4.0, 0.0), tree(2, 6.0, 0.0)], 2 * S), 2 * S)
    assert [t.x_m for t in again.trees.values()] == [6.0, 4.0]


# -- several flights


def test_two_flights_join_by_the_pattern_of_their_trees_whatever_compass_and_gps_say() -> None:
    book = Inventory(InventoryConfig(start_points=(START,)))
    world = forest(5)
    take(book, "uav1", listed(seen_from(world, 0.0, 0.0, 0.0, 1)), S)
    # begun 2 m off and 6 degrees askew of what the start point says
    take(book, "uav2", listed(seen_from(world, math.radians(6.0), 1.6, -1.2, 2), map_id="m2"), 2 * S)
    assert len(present(book)) == len(world)
    assert all(book.trees[k].flights == 2 for k in present(book))
    flight = book.flights[2]
    assert flight.aligned
    assert "laid on the inventory by 14 trees" in flight.note
    merged = [t for t in book.trees.values() if t.status == "merged"]
    assert all(t.merged_into in present(book) for t in merged)


def test_trees_that_come_later_join_as_they_come() -> None:
    book = Inventory(InventoryConfig(start_points=(START,)))
    world = forest(6)
    take(book, "uav1", listed(seen_from(world, 0.0, 0.0, 0.0, 1)), S)
    second = seen_from(world, 0.05, 0.5, 0.5, 2)
    for count in range(1, len(second) + 1):
        take(book, "uav2", listed(second[:count], count * S, map_id="m2"), count * S)
    assert len(present(book)) == len(world)


def test_a_forest_elsewhere_is_not_joined() -> None:
    book = Inventory(InventoryConfig(start_points=(START,)))
    take(book, "uav1", listed(forest(7)), S)
    take(book, "uav2", listed(forest(8), map_id="m2"), S)
    assert len(present(book)) == 28


def test_rows_of_a_plantation_are_too_alike_to_join() -> None:
    config = InventoryConfig(start_points=(START,))
    rows = [tree(5 * i + j + 1, 2.0 * i, 2.0 * j, 0.12) for i in range(5) for j in range(5)]
    book = Inventory(config)
    take(book, "uav1", listed(rows), S)
    take(book, "uav2", listed(seen_from(rows, 0.0, 1.0, 1.0, 2), map_id="m2"), S)
    flight = book.flights[2]
    assert not flight.aligned or len(present(book)) == 25  # never wrongly joined: not at all, or rightly


def test_local_flights_join_only_when_the_pattern_is_clear_and_say_that_they_are_local() -> None:
    book = Inventory(InventoryConfig())
    world = forest(9)
    take(book, "uav1", listed(world), S)
    take(book, "uav2", listed(seen_from(world, 2.0, 3.0, 1.0, 2), map_id="m2"), S)
    assert len(present(book)) == len(world)
    assert {t.frame for t in book.trees.values()} == {"local"}
    assert "local" in book.flights[1].note
    take(book, "uav3", listed(seen_from(world, 1.0, 0.0, 0.0, 4)[:5], map_id="m3"), S)
    assert not book.flights[3].aligned  # five trees without any prior are no proof


def test_a_map_begun_in_the_air_is_local_until_its_trees_place_it() -> None:
    book = Inventory(InventoryConfig(start_points=(START,)))
    world = forest(12)
    take(book, "uav1", listed(world), S)
    late = seen_from(world, 1.0, 3.0, 2.0, 2)
    book.take("uav1", listed(late[:6], map_id="m2"), 2 * S, in_air=True)
    assert {t.frame for t in book.trees.values() if t.fid > 14} == {"local"}
    assert "begun in the air" in book.flights[2].note
    assert not book.join_next(2 * S) or not book.flights[2].aligned
    book.take("uav1", listed(late, 3 * S, map_id="m2"), 3 * S)
    while book.join_next(3 * S):
        pass
    assert len(present(book)) == len(world)
    assert {book.trees[k].frame for k in present(book)} == {"global"}
    assert len(book.written().placed) == 14


def test_a_docked_tree_stays_visited() -> None:
    book = Inventory(InventoryConfig())
    book.take("uav1", listed([tree(1, 4.0, 0.0)]), S, frozenset({1, 77}))
    take(book, "uav1", listed([tree(1, 4.0, 0.0)], 2 * S), 2 * S)
    assert book.trees[1].visited


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.floats(-math.pi, math.pi), st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))
def test_alignment_is_right_or_absent(seed: int, yaw_rad: float, x_m: float, y_m: float) -> None:
    world = forest(seed)
    other = seen_from(world, yaw_rad, x_m, y_m, seed + 1)[:11]
    spots = [spots_of(trees) for trees in (other, world)]
    found = align(spots[0], spots[1], InventoryConfig(), None)
    assert found is not None
    assert math.remainder(found.theta_rad - yaw_rad, 2.0 * math.pi) == pytest.approx(0.0, abs=0.03)
    assert found.shift_m == pytest.approx((x_m, y_m), abs=0.15)
    far = align(spots[0], spots[1], InventoryConfig(), Prior(0.01, 0.05))
    askew = abs(math.remainder(yaw_rad, 2.0 * math.pi)) > 0.1
    assert far is None or not askew


@pytest.mark.parametrize("prior", [None, Prior(0.2, 3.0)])
def test_one_tree_far_off_takes_no_memory_and_moves_nothing(prior: Prior | None) -> None:
    world = forest(4, 16)
    flight = spots_of(seen_from(world, 0.08, 0.7, -0.4, 2))
    alone = align(flight, spots_of(world), InventoryConfig(), prior)
    assert alone is not None
    assert alone.agreeing == 16
    tracemalloc.start()
    beside = align(flight, spots_of([*world, tree(99, -400.0, 400.0)]), InventoryConfig(), prior)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert beside == alone
    assert peak_bytes < 20e6  # the box around all trees, in cells of 0.1 m: 134 MB


def test_with_a_prior_trees_out_of_reach_say_nothing_of_the_overlap() -> None:
    world = forest(4, 16)
    west = [t for t in world if t.x_m < -2.0]
    flight = spots_of(seen_from(world, 0.02, 0.1, -0.1, 2))
    prior = Prior(0.1, 0.5)
    alone = align(flight, spots_of(west), InventoryConfig(), prior)
    assert alone is not None
    assert len(west) < 0.4 * len(world)
    beyond = [tree(98, 400.0, -400.0), tree(99, 400.0, 400.0)]
    assert align(flight, spots_of([*west, *beyond]), InventoryConfig(), prior) == alone


def test_assignment_is_one_to_one_and_nearest_first() -> None:
    new = Spots.of([(0.0, 0.0, 0.1, 0.02, 0.01), (0.2, 0.0, 0.1, 0.02, 0.01)])
    known = Spots.of([(0.15, 0.0, 0.1, 0.02, 0.01)])
    assert list(assign(new, known, InventoryConfig())) == [-1, 0]
    thick = Spots.of([(0.15, 0.0, 0.3, 0.02, 0.01)])
    assert list(assign(new, thick, InventoryConfig())) == [-1, -1]
    assert list(assign(new, Spots.of([]), InventoryConfig())) == [-1, -1]


def test_a_thousand_trees_meet_a_thousand_in_memory_for_neighbours() -> None:
    rng = np.random.default_rng(3)
    known = Spots(
        rng.uniform(-80.0, 80.0, (1500, 2)), np.full(1500, 0.1), rng.uniform(0.0, 0.4, 1500), np.full(1500, 0.01)
    )
    new = Spots(
        known.xy_m + rng.normal(0.0, 0.3, (1500, 2)), known.radius_m, known.sigma_xy_m[::-1], known.sigma_radius_m
    )
    tracemalloc.start()
    found = assign(new, known, InventoryConfig())
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 10e6  # each with each: 126 MB, and 22 GB for two lists as long as a list may be
    distance = np.hypot(*(new.xy_m[:, None] - known.xy_m[None]).transpose(2, 0, 1))
    gate = np.clip(3.0 * np.hypot(new.sigma_xy_m[:, None], known.sigma_xy_m[None]), 0.3, 0.75)
    expected = np.full(1500, -1)
    for k in np.argsort(distance, axis=None)[: int(np.count_nonzero(distance <= 0.75))]:
        row, column = divmod(int(k), 1500)
        if distance[row, column] <= gate[row, column] and expected[row] < 0 and column not in expected:
            expected[row] = column
    assert np.array_equal(found, expected)
    assert np.count_nonzero(found >= 0) > 1000


def test_the_mean_leans_to_the_surer_flight() -> None:
    sure = belief_of(tree(1, 0.0, 0.0).model_copy(update={"sigma_xy_m": 0.02}))
    unsure = belief_of(tree(1, 0.0, 0.0).model_copy(update={"sigma_xy_m": 0.2, "suitable": False, "observations": 1}))
    fused = fuse([(sure, (0.0, 0.0, 0.0)), (unsure, (1.0, 0.0, 0.0))])
    assert fused.x_m == pytest.approx(0.0099, abs=1e-3)
    assert fused.sigma_xy_m < 0.02
    assert fused.suitable
