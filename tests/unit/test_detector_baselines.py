from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.detector.ransac_cylinder import detect_cylinders
from services.detector.reference import (
    circle_lm,
    density_m,
    detect_reference,
    euclidean_clusters,
    graham_hull,
    project_pairs,
)
from tests.unit.detector_clouds import Floats, ground, trunk

UP = (0.0, 0.0, 1.0)


def _forest() -> Floats:
    rng = np.random.default_rng(1)
    cloud = np.concatenate(
        [ground(step_m=0.03), trunk(2.0, 0.5, 0.12, rng, density=8000), trunk(-1.5, 1.0, 0.07, rng, density=8000)]
    )
    return np.asarray(cloud + rng.normal(0.0, 0.002, cloud.shape))


@pytest.mark.parametrize("method", [detect_reference, detect_cylinders])
def test_baselines_find_whole_trunks(method: object) -> None:
    assert callable(method)
    trunks = method(_forest(), UP).trunks
    assert sorted(round(t.radius_m, 2) for t in trunks) == pytest.approx([0.07, 0.12], abs=0.011)
    assert min(np.hypot(t.base_m[0] - 2.0, t.base_m[1] - 0.5) for t in trunks) < 0.02


@given(st.lists(st.tuples(st.integers(-20, 20), st.integers(-20, 20)), min_size=3, max_size=40, unique=True))
def test_graham_hull_holds_every_point(corners: list[tuple[int, int]]) -> None:
    points = np.array(corners, dtype=float)
    hull = graham_hull(points)
    if len(hull) < 3:
        return  # all on one line
    following = np.roll(hull, -1, axis=0)
    for p in points:
        edge, to = following - hull, p - hull
        assert (edge[:, 0] * to[:, 1] - edge[:, 1] * to[:, 0] >= -1e-9).all()


def test_circle_of_exact_points() -> None:
    a = np.linspace(0.0, 1.5, 12)
    x, y, r, rms = circle_lm(np.stack([1.0 + 0.2 * np.cos(a), -2.0 + 0.2 * np.sin(a)], axis=1))
    assert (x, y, r) == pytest.approx((1.0, -2.0, 0.2), abs=1e-6)
    assert rms < 1e-6


def test_pairs_cut_the_plane() -> None:
    below, above = np.array([[0.0, 0.0, 0.99], [1.0, 0.0, 0.99]]), np.array([[0.01, 0.0, 1.01], [1.0, 0.02, 1.01]])
    flat = project_pairs(np.concatenate([below, above]), 1.0, 0.06)
    assert flat == pytest.approx(np.array([[0.005, 0.0], [1.0, 0.01]]))


def test_clusters_and_density() -> None:
    g = np.stack(np.meshgrid(np.arange(10) * 0.01, np.arange(10) * 0.01), axis=2).reshape(-1, 2)
    two = np.concatenate([g, g + 0.2])
    assert sorted(len(c) for c in euclidean_clusters(two, 0.05)) == [100, 100]
    assert len(euclidean_clusters(two, 0.2)) == 1
    assert density_m(np.hstack([g, np.zeros((100, 1))])) == pytest.approx(0.01)


@pytest.mark.parametrize("method", [detect_reference, detect_cylinders])
@pytest.mark.parametrize("count", [1, 3, 40])
@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_baselines_take_clouds_without_anything(method: object, count: int, spread: float) -> None:
    assert callable(method)
    flat = np.random.default_rng(1).uniform(0.0, 5.0, (count, 3)) * [1.0, 1.0, 0.0]
    assert method(spread * flat, UP).trunks == ()
