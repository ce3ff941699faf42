"""All frames fused into one thin surface, told apart into ground, trees and the rest, and written."""

from __future__ import annotations

import csv
import io
import json
import re

import laspy
import numpy as np
import pytest

from services.common.geometry import Matrix, inverse, level_camera
from services.evaluate.fine import FineResult
from services.evaluate.fine_files import fine_files, ground_grid
from services.evaluate.fine_report import fine_section
from services.fine.config import FineConfig
from services.fine.gather import FineCloud, FineMap
from services.fine.model import StemPoints
from services.fine.segment import segment
from services.fine.stems import measure_stem
from tests.unit.fine_scene import ConeStem, Floats, seen_from

CONFIG = FineConfig()
STEM = ConeStem()
ORIGINS = np.stack([np.linspace(0.0, 1.0, 30), np.linspace(-0.3, 0.3, 30), np.full(30, 1.5)], axis=1)


def in_camera(points_map: Floats, T: Matrix) -> np.ndarray:
    back = inverse(T)
    return (points_map @ back[:3, :3].T + back[:3, 3]).astype(np.float32)


def ground_points(rng: np.random.Generator, n: int) -> Floats:
    xy = rng.uniform((-1.0, -2.0), (5.0, 2.0), (n, 2))
    return np.column_stack([xy, 0.05 * xy[:, 0] + rng.normal(0.0, 0.01, n)])


def fused() -> FineMap:
    """Return thirty frames of a stem on rising ground, with a crown over it and a bush beside it."""
    rng = np.random.default_rng(1)
    out = FineMap([STEM.tree()], CONFIG)
    points, frames = seen_from(STEM, ORIGINS, 3000, 2)
    crown = STEM.centre(np.array([3.2]))[0] + rng.uniform(-0.5, 0.5, (8000, 3)) * (1.0, 1.0, 1.4)
    bush = np.array([2.0, 0.85, 0.3]) + rng.uniform(-0.2, 0.2, (1500, 3))
    leaves = np.concatenate([crown, bush])
    for f, origin in enumerate(ORIGINS):
        T = level_camera(origin, 0.0)
        shown = leaves[rng.random(len(leaves)) < 0.5]
        shown = shown + rng.normal(0.0, 0.002, shown.shape)
        seen = np.concatenate([points[frames == f], ground_points(rng, 3000), shown])
        out.add(in_camera(seen, T), np.full((len(seen), 3), 90, dtype=np.uint8), T, f)
    return out


@pytest.fixture(scope="module")
def fine() -> FineResult:
    gathered = fused()
    cloud = gathered.cloud()
    (tree, seen), *_ = gathered.stems()
    stem = measure_stem(tree, seen, ORIGINS, CONFIG)
    assert stem is not None
    return FineResult(cloud, segment(cloud.points_m, [tree], CONFIG), (stem,), (9,), 30, gathered.left_out, 1.0)


def test_the_surface_is_thinner_than_the_noise(fine: FineResult) -> None:
    raw, _ = seen_from(STEM, ORIGINS, 3000, 2)
    on_stem = fine.cloud.points_m[fine.cloud.fine & (fine.segments.tree_id == 5)]

    def scatter(points: np.ndarray) -> float:
        p = points[(points[:, 2] > 0.4) & (points[:, 2] < 2.4)].astype(float)
        away = np.hypot(*(p[:, :2] - STEM.centre(p[:, 2])[:, :2]).T) - 0.5 * STEM.diameter(p[:, 2])
        return float(1.4826 * np.median(np.abs(away)))

    assert len(on_stem) > 3000
    assert scatter(on_stem) < 0.6 * scatter(raw)


def test_two_fusions_give_the_same_cloud(fine: FineResult) -> None:
    again = fused().cloud()
    assert np.array_equal(again.points_m, fine.cloud.points_m)


def test_each_point_is_told_what_it_is_part_of(fine: FineResult) -> None:
    points, segments = fine.cloud.points_m, fine.segments
    foot = (np.abs(points[:, 1]) < 1.5) & (points[:, 2] < 0.02 + 0.05 * points[:, 0]) & (points[:, 0] < 1.5)
    assert segments.ground[foot].mean() > 0.9
    assert (segments.tree_id[segments.ground] == 0).all()
    crown = points[:, 2] > 2.8
    assert (segments.tree_id[crown] == 5).mean() > 0.8
    bush = (points[:, 1] > 0.75) & (points[:, 2] < 0.6) & (points[:, 2] > 0.25)
    assert (segments.tree_id[bush] == 0).all()
    assert np.abs(segments.height_m[segments.ground]).max() < 0.09


def test_memory_is_bounded_and_what_had_no_room_is_counted() -> None:
    small = FineMap([], FineConfig(max_voxels=2000))
    rng = np.random.default_rng(4)
    T = np.eye(4)
    for f in range(4):
        points = rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (5000, 3)).astype(np.float32)
        small.add(points, np.zeros((5000, 3), dtype=np.uint8), T, f)
    assert small.left_out > 10_000
    assert len(small.cloud().points_m) <= 2000


def test_no_trees_and_no_ground_are_no_fault() -> None:
    empty = FineMap([], CONFIG)
    cloud = empty.cloud()
    assert len(cloud.points_m) == 0
    result = FineResult(cloud, segment(cloud.points_m, [], CONFIG), (), (), 0, 0, 0.0)
    files = fine_files(result, 0)
    assert "ground_fine.asc" not in files
    assert json.loads(files["trees_fine.json"])["trees"] == []
    assert "No stem" in "".join(fine_section(result, []))
    wall = np.column_stack([np.full(4000, 2.0), *np.random.default_rng(1).uniform(-1.0, 1.0, (2, 4000))]).astype(
        np.float32
    )
    told = segment(wall, [], CONFIG)
    assert (told.tree_id == 0).all()


def test_files_say_what_was_found(fine: FineResult) -> None:
    files = fine_files(fine, 1_700_000_000_000_000_000)
    las = laspy.read(io.BytesIO(files["fine_cloud.laz"]))
    assert np.array_equal(np.asarray(las["tree_id"]), fine.segments.tree_id)
    assert set(np.unique(las.classification)) == {1, 2, 5}
    body = json.loads(files["trees_fine.json"])
    assert body["not_measured"] == [9]
    (tree,) = body["trees"]
    assert tree["id"] == 4
    assert tree["diameter_13_m"] == pytest.approx(0.24, abs=0.004)
    assert len(tree["sections"]) == len(fine.stems[0].sections)
    rows = list(csv.DictReader(io.StringIO(files["sections_fine.csv"].decode())))
    assert [float(r["height_m"]) for r in rows] == [s["height_m"] for s in tree["sections"]]
    assert next(csv.DictReader(io.StringIO(files["trees_fine.csv"].decode())))["suitable"] == "true"


def test_the_ground_grid_has_the_slope(fine: FineResult) -> None:
    grid = ground_grid(fine.segments)
    assert grid is not None
    lines = grid.decode().splitlines()
    head = {line.split()[0]: float(line.split()[1]) for line in lines[:6]}
    values = np.array([[float(v) for v in line.split()] for line in lines[6:]])
    assert values.shape == (int(head["nrows"]), int(head["ncols"]))
    x = head["xllcorner"] + (np.arange(values.shape[1]) + 0.5) * head["cellsize"]
    seen = values > -100.0
    assert seen.mean() > 0.5
    expected = np.broadcast_to(0.05 * x, values.shape)
    assert np.median(np.abs(values[seen] - expected[seen])) < 0.02


def test_the_report_shows_the_stem(fine: FineResult) -> None:
    page = "\n".join(fine_section(fine, [STEM.tree()]))
    assert "Finer map" in page
    assert page.count("<svg") == 2
    assert re.search(r"4: 2[34]\.\d ± 0\.\d cm at 1\.30 m", page)
    assert 'id="f4"' in page


def test_points_beyond_the_bound_are_thinned_evenly() -> None:
    few = FineMap([STEM.tree()], FineConfig(max_stem_points=20_000))
    points, frames = seen_from(STEM, ORIGINS, 3000, 2)
    for f, origin in enumerate(ORIGINS):
        T = level_camera(origin, 0.0)
        own = in_camera(points[frames == f].astype(float), T)
        few.add(own, np.zeros((len(own), 3), dtype=np.uint8), T, f)
    (_, seen), *_ = few.stems()
    assert isinstance(seen, StemPoints)
    assert 5_000 < len(seen.points_m) <= 20_000
    counts = np.bincount(seen.frame, minlength=30)
    assert counts.min() > 0.4 * counts.max()


def test_a_cloud_of_nothing_fine() -> None:
    cloud = FineCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, dtype=bool))
    assert len(segment(cloud.points_m, [STEM.tree()], CONFIG).tree_id) == 0
