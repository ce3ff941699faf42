"""The ground per cell, and memory that follows the surface."""

from __future__ import annotations

import numpy as np
import pytest

from services.common.geometry import level_camera
from services.evaluate.ring_walk import walk
from services.mapper.cloud import KeyframeCloud
from services.mapper.config import MapperConfig
from services.mapper.dense_map import DenseMap, MapSubmap
from services.mapper.ground_model import GroundModel


def submap(points_m: np.ndarray, number: int = 0) -> MapSubmap:
    return MapSubmap(number, 0, points_m.astype(np.float32), np.zeros((len(points_m), 3), np.uint8), np.eye(4))


def slope(n: int, rng: np.random.Generator, low: float = -3.0, high: float = 3.0) -> np.ndarray:
    """Ground that rises 0.3 along x and falls 0.1 along y, rough by 1.5 cm."""
    x, y = rng.uniform(low, high, n), rng.uniform(low, high, n)
    return np.stack([x, y, 0.3 * x - 0.1 * y + rng.normal(0, 0.015, n)], axis=1)


def model_of(*clouds: np.ndarray) -> GroundModel:
    model = GroundModel(0.5)
    submaps = {k: submap(points, k) for k, points in enumerate(clouds)}
    model.touch(submaps.values())
    model.refresh(submaps)
    return model


def test_height_slope_and_relief() -> None:
    model = model_of(slope(60_000, np.random.default_rng(0)))
    inner = [p for (c, r), p in model.cells.items() if -5 <= c < 5 and -5 <= r < 5]
    assert len(inner) == 100
    for (column, row), plane in model.cells.items():
        x, y = (column + 0.5) * 0.5, (row + 0.5) * 0.5
        if max(abs(x), abs(y)) < 2.5:
            assert plane.height_m == pytest.approx(0.3 * x - 0.1 * y, abs=0.01)
    assert np.mean([p.slope_x for p in inner]) == pytest.approx(0.3, abs=0.01)
    assert np.mean([p.slope_y for p in inner]) == pytest.approx(-0.1, abs=0.01)
    assert np.mean([p.relief_m for p in inner]) == pytest.approx(0.015, abs=0.004)
    assert model.height_m(1.1, -0.7) == pytest.approx(0.3 * 1.1 + 0.07, abs=0.02)
    assert model.height_m(50.0, 0.0) is None


def test_what_stands_on_the_ground_is_none_of_it() -> None:
    rng = np.random.default_rng(1)
    angle, z = rng.uniform(0, 2 * np.pi, 8000), rng.uniform(0.0, 2.5, 8000)
    trunk = np.stack([0.25 + 0.15 * np.cos(angle), 0.25 + 0.15 * np.sin(angle), z + 0.05], axis=1)
    bush = rng.uniform([1.0, 1.0, 0.5], [1.9, 1.9, 1.5], (8000, 3))
    model = model_of(slope(60_000, rng), trunk, bush)
    assert model.height_m(0.25, 0.25) == pytest.approx(0.05, abs=0.04)
    assert model.height_m(1.25, 1.25) == pytest.approx(0.25, abs=0.04)


def test_a_moved_submap_takes_its_ground_along_and_only_that_is_redone() -> None:
    rng = np.random.default_rng(2)
    here, there = submap(slope(20_000, rng), 0), submap(slope(20_000, rng, 20.0, 26.0), 1)
    model = GroundModel(0.5)
    both = {0: here, 1: there}
    model.touch(both.values())
    first = model.refresh(both)
    assert not model.refresh(both).cells, "nothing touched, nothing told"
    there.T_map_submap = np.eye(4)
    there.T_map_submap[2, 3] = 0.2
    model.touch([there])
    second = model.refresh(both)
    assert second.cells
    assert all(column >= 36 for column, _ in second.cells)
    for at, plane in second.cells.items():
        assert plane.height_m == pytest.approx(first.cells[at].height_m + 0.2, abs=0.02)
    there.points_m = there.points_m[:0]
    model.touch([there])
    assert set(model.refresh(both).gone) == set(second.cells)


def test_memory_grows_with_the_area_and_time_does_not_grow() -> None:
    """Wide margins: a walk four times as long; the benchmark has the ten times."""
    walk(4)
    short, long = walk(15), walk(60)
    assert long.area_m2 > 2.5 * short.area_m2
    assert long.nbytes / long.area_m2 < 1.5 * short.nbytes / short.area_m2
    assert np.median(long.keyframe_ms[-15:]) < 4.0 * np.median(short.keyframe_ms[5:])


def test_a_doubled_surface_becomes_one_after_the_loop_closes() -> None:
    """A drifted second look takes voxels of its own; when it is moved onto the first, what is there already goes."""
    rng = np.random.default_rng(3)
    wall = np.stack([rng.uniform(-1, 1, 40_000), rng.uniform(-1, 1, 40_000), np.full(40_000, 2.0)], axis=1)
    cloud = KeyframeCloud(wall.astype(np.float32), np.zeros((40_000, 3), dtype=np.uint8))
    dense = DenseMap(MapperConfig())
    at, drifted = level_camera([0, 0, 1.5], 0.0), level_camera([0.15, 0, 1.5], 0.0)
    dense.add(0, 0, cloud, at)
    dense.add(1, 1, cloud, drifted)
    single, doubled = len(dense.submaps[0].points_m), dense.size
    assert doubled > 1.8 * single
    moves = dense.move({0: at, 1: at.copy()})
    assert [s.submap_id for s in moves.thinned] == [1]
    assert dense.size < 1.1 * single
    assert dense.size == sum(len(s.points_m) for s in dense.submaps.values())
    third = dense.add(2, 2, cloud, at)[0]
    assert len(third.points_m) < 0.05 * single, "the voxels of the place that was left are free, those here are not"
    away = dense.add(3, 3, cloud, drifted)[0]
    assert len(away.points_m) > 0.9 * single


def test_looking_for_long_fills_no_shell_of_noise() -> None:
    """Range noise puts every look's points into other voxels: after enough looks only what is new gets in."""
    rng = np.random.default_rng(4)
    dense, at = DenseMap(MapperConfig()), level_camera([0, 0, 1.5], 0.0)
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 150), np.linspace(-0.8, 0.8, 120)), axis=2).reshape(-1, 2)
    sizes = []
    for look in range(40):
        z = 4.0 + rng.normal(0.0, 0.03, len(grid))
        cloud = np.column_stack([grid * (z / 4.0)[:, None], z]).astype(np.float32)
        dense.add(look, look, KeyframeCloud(cloud, np.zeros((len(cloud), 3), dtype=np.uint8)), at)
        sizes.append(dense.size)
    first, enough, last = sizes[0], sizes[11], sizes[39]
    assert enough > 2.0 * first, "the first looks all count: their mean is better than one"
    assert last < 1.15 * enough
    new = np.column_stack([grid, np.full(len(grid), 2.5)]).astype(np.float32)
    submap = dense.add(99, 99, KeyframeCloud(new, np.zeros((len(new), 3), dtype=np.uint8)), at)[0]
    assert len(submap.points_m) > 0.8 * len(new), "what is new still gets in"
