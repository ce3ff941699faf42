from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from services.common.geometry import level_camera
from services.detector.config import DetectorServiceConfig
from services.detector.identity import Identities
from services.detector.map_store import anchor_of
from services.detector.model import Trunk


def trunk_at(x: float, y: float, radius: float = 0.1) -> Trunk:
    return Trunk(
        base_m=(x, y, 0.0), axis=(0.0, 0.0, 1.0), radius_m=radius, radius_height_m=1.3, taper=0.0, height_seen_m=3.0,
        low_seen_m=0.3, sigma_xy_m=0.005, sigma_radius_m=0.002, arc_rad=2.0, confidence=0.9, layers=19, points=900,
        noise_m=0.01, lean_rad=0.0, suitable=True, remark="",
    )  # fmt: skip


def _ids(identities: Identities) -> dict[int, tuple[float, float]]:
    return {t.tree_id: t.trunk.base_m[:2] for t in identities.trees}


def test_ids_stay_whatever_the_order() -> None:
    ids = Identities(DetectorServiceConfig())
    ids.update([trunk_at(1, 0), trunk_at(3, 0), trunk_at(0, 4)])
    first = _ids(ids)
    ids.update([trunk_at(0.03, 4.02), trunk_at(1.02, 0), trunk_at(3.01, 0.02)])
    assert _ids(ids).keys() == first.keys()
    for tree_id, place in _ids(ids).items():
        assert np.hypot(place[0] - first[tree_id][0], place[1] - first[tree_id][1]) < 0.1
    assert all(t.observations == 2 for t in ids.trees)


def test_another_radius_is_another_tree_and_ids_are_never_used_again() -> None:
    ids = Identities(DetectorServiceConfig(forget_after=1))
    ids.update([trunk_at(1, 0, 0.05)])
    ids.update([trunk_at(1.05, 0, 0.35)])
    assert [t.tree_id for t in ids.trees] == [2]


def test_forgotten_after_some_misses() -> None:
    ids = Identities(DetectorServiceConfig(forget_after=2))
    ids.update([trunk_at(1, 0)])
    ids.update([])
    assert [t.missed for t in ids.trees] == [1]
    ids.update([trunk_at(1, 0)])
    assert [(t.tree_id, t.missed) for t in ids.trees] == [(1, 0)]
    ids.update([])
    ids.update([])
    assert ids.trees == []


def test_close_trees_do_not_swap() -> None:
    ids = Identities(DetectorServiceConfig())
    ids.update([trunk_at(1.0, 0.0), trunk_at(1.35, 0.0)])
    ids.update([trunk_at(1.40, 0.0), trunk_at(1.08, 0.0)])
    assert _ids(ids) == {1: (1.08, 0.0), 2: (1.40, 0.0)}


def test_the_anchor_is_the_submap_that_looks_at_it() -> None:
    poses = {4: level_camera([0, 0, 1.5], 0.0), 5: level_camera([0, 0, 1.5], np.pi / 2)}
    found = [anchor_of(np.array(p), poses) for p in ([3.0, 0.2, 0.0], [0.2, 3.0, 0.0], [0.0, -9.0, 0.0])]
    assert [a and a.submap_id for a in found] == [4, 5, None]


def test_ids_follow_a_map_correction() -> None:
    ids = Identities(DetectorServiceConfig())
    ids.update([trunk_at(4.0, 0.0), trunk_at(4.0, 0.7)])
    ids.fasten({1: level_camera([0, 0, 1.5], 0.0)})
    ids.follow({1: level_camera([0, 0, 1.5], 0.15)})  # a loop closes: everything turns by 0.15 rad, 0.6 m at 4 m
    c, s = np.cos(0.15), np.sin(0.15)
    assert _ids(ids)[2] == pytest.approx((4 * c - 0.7 * s, 4 * s + 0.7 * c))
    ids.update([trunk_at(4 * c, 4 * s), trunk_at(4 * c - 0.7 * s, 4 * s + 0.7 * c)])
    assert {t.tree_id: round(t.trunk.base_m[1], 2) for t in ids.trees} == {
        1: round(4 * s, 2),
        2: round(4 * s + 0.7 * c, 2),
    }


def test_a_tree_whose_anchor_is_gone_follows_its_neighbours() -> None:
    ids = Identities(DetectorServiceConfig())
    ids.update([trunk_at(4.0, 0.0), trunk_at(4.0, 0.7), trunk_at(-30.0, 0.0)])
    ids.fasten({1: level_camera([0, 0, 1.5], 0.0), 2: level_camera([0, 0, 1.5], 0.3)})
    assert [t.anchor and t.anchor.submap_id for t in ids.trees] == [1, 2, None]
    ids.follow({2: level_camera([0.5, 0, 1.5], 0.3)})
    assert _ids(ids) == {1: pytest.approx((4.5, 0.0)), 2: pytest.approx((4.5, 0.7)), 3: (-30.0, 0.0)}
    assert ids.forget_unled({2: level_camera([0.5, 0, 1.5], 0.3)}) == [3]
    assert list(_ids(ids)) == [1, 2]


def test_what_happens_to_trees_is_told() -> None:
    ids = Identities(DetectorServiceConfig(forget_after=2))
    assert [(e.kind, e.tree_id) for e in ids.update([trunk_at(1, 0, 0.12), trunk_at(1.2, 0, 0.12)])] == [
        ("appeared", 1), ("appeared", 2),
    ]  # fmt: skip
    (merged,) = ids.update([trunk_at(1.08, 0, 0.2)])
    assert (merged.kind, merged.tree_id, merged.other_id) == ("merged", 2, 1)
    assert [t.tree_id for t in ids.trees] == [1], "at once, not after some misses"
    (split,) = ids.update([trunk_at(1.0, 0, 0.12), trunk_at(1.2, 0, 0.12)])
    assert (split.kind, split.tree_id, split.other_id) == ("split", 3, 1)
    assert ids.update([trunk_at(1.0, 0, 0.12)]) == [], "missed once is not gone"
    (gone,) = ids.update([trunk_at(1.0, 0, 0.12)])
    assert str(gone) == "tree 3 is gone"


def large(count: int = 1000) -> tuple[Identities, np.ndarray]:
    """Return the trees of a large map, four square metres for each, and their places (N, 2)."""
    ids = Identities(DetectorServiceConfig())
    xy = np.random.default_rng(4).uniform(0.0, 2.0 * np.sqrt(count), (count, 2))
    ids.update([trunk_at(float(x), float(y)) for x, y in xy])
    return ids, xy


def least_s(work: Callable[[], object]) -> float:
    """Return the processor time of the quickest of three runs."""
    spent = []
    for _ in range(3):
        begin_s = time.thread_time()
        work()
        spent.append(time.thread_time() - begin_s)
    return min(spent)


def test_a_thousand_trees_are_matched_with_their_neighbours_only() -> None:
    ids, xy = large()
    seen = xy + np.random.default_rng(5).normal(0.0, 0.005, xy.shape)
    trunks = [trunk_at(float(x), float(y)) for x, y in seen]
    assert least_s(lambda: ids.update(trunks)) < 0.3  # 1.7 s each with each
    assert [t.tree_id for t in ids.trees] == list(range(1, 1001))
    assert all(t.missed == 0 and t.observations == 4 for t in ids.trees)
    off = [np.hypot(*(np.array(t.trunk.base_m[:2]) - place)) for t, place in zip(ids.trees, xy, strict=True)]
    assert np.median(off) < 0.01


def test_a_thousand_trees_are_fastened_to_five_hundred_submaps_in_a_moment() -> None:
    ids, xy = large()
    rng = np.random.default_rng(6)
    places = rng.uniform(0.0, xy.max(), (500, 2))
    poses = {k: level_camera((x, y, 1.5), float(rng.uniform(-3.0, 3.0))) for k, (x, y) in enumerate(places.tolist())}
    assert least_s(lambda: ids.fasten(poses)) < 0.2  # 0.7 s with each pose on its own
    for tree in ids.trees[::100]:
        to = {k: np.array(tree.trunk.base_m[:2]) - T[:2, 3] for k, T in poses.items()}
        near = [k for k in poses if 0.3 < np.hypot(*to[k]) < 6.0]
        squarest = max(near, key=lambda k: float(poses[k][:2, 2] @ to[k]) / float(np.hypot(*to[k])))
        assert tree.anchor is not None
        assert tree.anchor.submap_id == squarest
