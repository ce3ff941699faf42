"""The three ways of looking, each with truth: a single frame, a walk sideways past a row, a full turn on the spot.

And forks of which one arm is hidden: a stem that ends low and one arm above it are one tree that is not suitable.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from services.detector.detect import detect_trees
from services.detector.model import Trunk, Views
from tests.unit.detector_clouds import Floats, facing, ground, trunk, with_depth_noise

_HALF_VIEW_RAD = 0.51
_REACH_M = 6.0
Place = tuple[float, float, float]
"""x, y and radius of a trunk."""


def _look(eye: tuple[float, float], yaw: float, places: Sequence[Place], rng: np.random.Generator) -> Floats:
    """Return what a level camera at 1.5 m sees: near ground and the facing sides of trunks, within its field of view."""
    parts = [ground(8.0, 0.08)]
    parts += [trunk(x, y, r, rng, height=3.4, arc=facing(x, y, eye), density=4000.0) for x, y, r in places]
    points = np.concatenate(parts)
    d = points[:, :2] - eye
    away = np.abs((np.arctan2(d[:, 1], d[:, 0]) - yaw + np.pi) % (2 * np.pi) - np.pi)
    distance = np.hypot(d[:, 0], d[:, 1])
    seen = (away < _HALF_VIEW_RAD) & (distance > 0.5) & (distance < _REACH_M)
    return with_depth_noise(points[seen], np.array([*eye, 1.5]), rng)


def _map(
    looks: Sequence[tuple[tuple[float, float], float]], places: Sequence[Place], seed: int
) -> tuple[Floats, Views]:
    rng = np.random.default_rng(seed)
    seen = [_look(eye, yaw, places, rng) for eye, yaw in looks]
    index = np.repeat(np.arange(len(looks)), [len(s) for s in seen]).astype(np.int32)
    return np.concatenate(seen), Views(index, np.array([[x, y, 1.5] for (x, y), _ in looks]))


def _match(trunks: Sequence[Trunk], places: Sequence[Place]) -> None:
    assert len(trunks) == len(places)
    for x, y, radius in places:
        t = min(trunks, key=lambda t: float(np.hypot(t.base_m[0] - x, t.base_m[1] - y)))
        assert np.hypot(t.base_m[0] - x, t.base_m[1] - y) < 0.03
        assert t.radius_m == pytest.approx(radius, abs=0.010)
        assert t.suitable


def test_a_single_frame() -> None:
    places = [(2.5, 0.3, 0.06), (3.6, -1.0, 0.12), (4.2, 1.2, 0.17)]
    _match(detect_trees(*_with_up(_map([((0.0, 0.0), 0.0)], places, 1))).trunks, places)


def test_a_sideways_walk_past_a_row() -> None:
    places = [(1.5 * k, 3.0, 0.05 + 0.02 * k) for k in range(6)]
    looks = [((0.5 * k, 0.0), np.pi / 2) for k in range(16)]
    _match(detect_trees(*_with_up(_map(looks, places, 2))).trunks, places)


def test_a_full_turn() -> None:
    angles = np.radians([0.0, 65.0, 130.0, 200.0, 290.0])
    places = [
        (r * np.cos(a), r * np.sin(a), 0.06 + 0.02 * k)
        for k, (a, r) in enumerate(zip(angles, (2, 3, 4, 3, 4), strict=True))
    ]
    looks = [((0.0, 0.0), yaw) for yaw in np.arange(0.0, 2 * np.pi, 0.26)]
    _match(detect_trees(*_with_up(_map(looks, places, 3))).trunks, places)


def _with_up(seen: tuple[Floats, Views]) -> tuple[Floats, tuple[float, float, float], Views]:
    return seen[0], (0.0, 0.0, 1.0), seen[1]


@pytest.mark.parametrize("fork_m", [0.8, 0.95])
def test_one_arm_on_a_stem_is_a_fork(fork_m: float) -> None:
    rng = np.random.default_rng(5)
    seen = facing(3.0, 0.0)
    stem = trunk(3.0, 0.0, 0.10, rng, height=fork_m, arc=seen, density=6000.0)
    arm = trunk(
        3.0, -0.30 * fork_m, 0.075, rng, height=3.4, low=fork_m + 0.1, lean=(0.0, 0.30), arc=seen, density=6000.0
    )
    cloud = with_depth_noise(np.concatenate([ground(), stem, arm]), np.array([0.0, 0.0, 1.5]), rng)
    views = Views(np.zeros(len(cloud), dtype=np.int32), np.array([[0.0, 0.0, 1.5]]))
    trunks = detect_trees(cloud, views=views).trunks
    assert len(trunks) == 1
    assert not trunks[0].suitable
    assert trunks[0].remark.startswith("forks")
    assert np.hypot(trunks[0].base_m[0] - 3.0, trunks[0].base_m[1]) < 0.06


def test_a_leaning_trunk_whose_foot_is_hidden_is_no_fork() -> None:
    rng = np.random.default_rng(6)
    leaning = trunk(3.0, -0.2, 0.09, rng, height=3.4, low=1.0, lean=(0.0, 0.25), arc=facing(3.0, 0.0), density=6000.0)
    cloud = with_depth_noise(np.concatenate([ground(), leaning]), np.array([0.0, 0.0, 1.5]), rng)
    views = Views(np.zeros(len(cloud), dtype=np.int32), np.array([[0.0, 0.0, 1.5]]))
    trunks = detect_trees(cloud, views=views).trunks
    assert len(trunks) == 1
    assert trunks[0].suitable
