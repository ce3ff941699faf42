"""The mapper's tables: voxels by segments, footprints by blocks; what they hold does not depend on how they grew."""

from __future__ import annotations

import numpy as np
import pytest

from services.mapper.config import MapperConfig
from services.mapper.footprints import Footprint, Footprints
from services.mapper.voxel_table import VoxelTable

LOWS = np.full((64, 64), 1e9, dtype=np.float32)
"""No ground anywhere: every voxel is a coarse one, 3 cm."""


def _lattice(side: int, low: float = 0.0) -> np.ndarray:
    at = low + 0.03 * (np.arange(side) + 0.5)
    return np.stack(np.meshgrid(at, at, at), axis=-1).reshape(-1, 3).astype(np.float32)


def test_every_voxel_is_taken_once_however_the_table_grew() -> None:
    table, points = VoxelTable(MapperConfig()), _lattice(60)
    admitted = [table.admit(part, np.eye(4), LOWS)[0] for part in np.array_split(points, 50)]
    assert all(keep.all() for keep in admitted)
    assert not any(table.admit(part, np.eye(4), LOWS)[0].any() for part in np.array_split(points, 7))
    assert table.nbytes < 100 * len(points)


def test_voxels_given_back_are_taken_again() -> None:
    table, points = VoxelTable(MapperConfig()), _lattice(40)
    _, keys = table.admit(points, np.eye(4), LOWS)
    table.release(keys[::2])
    keep, _ = table.admit(points, np.eye(4), LOWS)
    assert keep[::2].all()
    assert not keep[1::2].any()


def test_a_table_at_its_bound_refuses_and_takes_again_what_was_given_back() -> None:
    table = VoxelTable(MapperConfig(max_points=1))
    points = _lattice(120)  # 1.7 million; the bound and its spare are 0.8
    keep, keys = table.admit(points, np.eye(4), LOWS)
    assert 400_000 < np.count_nonzero(keep) < len(points)
    table.release(keys[keep])
    keep, _ = table.admit(_lattice(60, low=20.0), np.eye(4), LOWS)
    assert keep.all()


def test_giving_back_and_taking_for_long_needs_no_more_memory() -> None:
    table, points = VoxelTable(MapperConfig()), _lattice(20)
    T, sizes = np.eye(4), []
    for k in range(60):
        T[0, 3] = k
        keep, keys = table.admit(points, T, LOWS)
        assert keep.all()
        table.release(keys)
        sizes.append(table.nbytes)
    assert sizes[-1] <= 2 * sizes[10]


def test_footprints_near_a_place_are_those_whose_boxes_meet() -> None:
    rng, prints = np.random.default_rng(3), Footprints()
    boxes = {}
    for number in range(200):
        low = rng.integers(-200, 200, 2)
        cells = np.stack([low, low + rng.integers(0, 30, 2)])
        prints.put(number, Footprint(cells, np.eye(4), 1))
        boxes[number] = (*cells[:, 0].tolist(), *cells[:, 1].tolist())
    for number in range(0, 200, 3):
        prints.drop(number)
        del boxes[number]
    for _ in range(50):
        a, c = rng.integers(-220, 220, 2).tolist()
        b, d = a + int(rng.integers(0, 60)), c + int(rng.integers(0, 60))
        meet = [k for k, p in boxes.items() if p[0] <= b and p[1] >= a and p[2] <= d and p[3] >= c]
        assert prints.near((a, b, c, d)) == sorted(meet)


@pytest.mark.parametrize("known", [True, False])
def test_a_footprint_dropped_is_gone(known: bool) -> None:
    prints = Footprints()
    if known:
        prints.put(5, Footprint(np.array([[1, 1], [2, 2]]), np.eye(4), 1))
    prints.drop(5)
    assert prints.get(5) is None
    assert prints.near((0, 9, 0, 9)) == []
