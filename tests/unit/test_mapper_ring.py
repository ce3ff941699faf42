"""The measures of doubled trunks say what they should on rings that were made."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.simulation import TrueTree
from services.evaluate.bench_peers import PeerCloud, match
from services.evaluate.ring import MapPoints, Ring, ring_of

TREE = TrueTree(x_m=2.0, y_m=1.0, z_m=-0.2, axis=(0.0, 0.0, 1.0), radius_m=0.12, suitable=True, fair=True)


def trunk(n: int, sigma_m: float, shift_m: float, keyframe: int, rng: np.random.Generator) -> MapPoints:
    """Points on the near half of the trunk, noise across the bark."""
    angle, z = rng.uniform(np.pi / 2, 3 * np.pi / 2, n), rng.uniform(0.0, 2.2, n)
    r = 0.12 + rng.normal(0.0, sigma_m, n)
    points = np.stack([2.0 + r * np.cos(angle) - shift_m, 1.0 + r * np.sin(angle), z - 0.2], axis=1)
    return MapPoints(points, np.full(n, keyframe))


def ring(*parts: MapPoints) -> Ring:
    cloud = MapPoints(np.concatenate([p.points_m for p in parts]), np.concatenate([p.keyframe for p in parts]))
    result = ring_of(cloud, TREE)
    assert result is not None
    return result


@pytest.mark.parametrize("sigma_m", [0.005, 0.015])
def test_one_surface_has_its_noise_as_thickness_and_nothing_doubled(sigma_m: float) -> None:
    rng = np.random.default_rng(1)
    r = ring(*(trunk(4000, sigma_m, 0.0, k, rng) for k in range(3)))
    assert r.thickness_m == pytest.approx(sigma_m, rel=0.1)
    assert r.doubled_share == 0.0
    assert r.view_spread_m < 0.4 * sigma_m
    assert r.keyframes == 3


def test_a_second_surface_is_told() -> None:
    rng = np.random.default_rng(2)
    r = ring(trunk(6000, 0.005, 0.0, 0, rng), trunk(3000, 0.005, 0.06, 1, rng))
    assert r.doubled_share == pytest.approx(1 / 3, abs=0.12)
    assert r.view_spread_m == pytest.approx(0.03 * 0.7, abs=0.01), "half the shift, less where it is along the bark"
    assert r.thickness_m > 0.02


def test_a_map_moved_as_a_whole_is_not_thick() -> None:
    rng = np.random.default_rng(3)
    r = ring(trunk(6000, 0.006, 0.1, 0, rng))
    assert r.thickness_m == pytest.approx(0.006, rel=0.15)
    assert r.centre_m[0] ** 2 + r.centre_m[1] ** 2 == pytest.approx(0.01, rel=0.1)


def test_too_few_points_are_no_ring() -> None:
    assert ring_of(trunk(100, 0.01, 0.0, 0, np.random.default_rng(0)), TREE) is None


def test_peers_are_counted_once_and_the_unfair_are_neither_found_nor_false() -> None:
    nan = float("nan")
    cloud = PeerCloud("c", np.zeros((1, 3)), ((0.0, 0.0, 0.1), (3.0, 0.0, nan)), ignored=((5.0, 5.0, 0.3),))
    pairs, false = match(
        [(0.05, 0.0, 0.11), (0.1, 0.0, 0.12), (3.1, 0.0, 0.4), (5.2, 5.3, 0.2), (8.0, 0.0, 0.1)], cloud
    )
    assert [f for _, f in pairs] == [(0.05, 0.0, 0.11), (3.1, 0.0, 0.4)]
    assert false == 2, "the second stem at a true one, and one where nothing stands"
    assert match([(0.05, 0.0, 0.2)], cloud) == ([], 1), "of a quite different radius"
