from __future__ import annotations

import numpy as np
import pytest

from services.detector.detect import detect_trees
from services.detector.model import Views
from tests.unit.detector_clouds import Floats, bush, facing, ground, trunk, wall, with_depth_noise

EYE = np.array([0.0, 0.0, 1.5])


def _views(n: int) -> Views:
    return Views(np.zeros(n, dtype=np.int32), EYE[None])


def _camera_views(n: int, yaw: float) -> Views:
    """One level camera at EYE that looks along ``yaw``."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[s, 0.0, c], [-c, 0.0, s], [0.0, -1.0, 0.0]])
    return Views(np.zeros(n, dtype=np.int32), EYE[None], R[None], (0.64, 0.48))


def _scene(*parts: Floats) -> Floats:
    return np.concatenate([ground(), *parts])


def test_whole_trunks_are_found_and_measured() -> None:
    rng = np.random.default_rng(1)
    cloud = _scene(trunk(2.0, 0.5, 0.12, rng), trunk(-1.0, 2.0, 0.05, rng, taper=-0.005), trunk(0.0, -3.0, 0.19, rng))
    cloud += rng.normal(0.0, 0.003, cloud.shape)
    result = detect_trees(cloud)
    assert len(result.trunks) == 3
    for t in result.trunks:
        true = min(
            ((2.0, 0.5, 0.12), (-1.0, 2.0, 0.05), (0.0, -3.0, 0.19)),
            key=lambda g: np.hypot(g[0] - t.base_m[0], g[1] - t.base_m[1]),
        )
        assert t.base_m[0] == pytest.approx(true[0], abs=0.01)
        assert t.base_m[1] == pytest.approx(true[1], abs=0.01)
        assert t.base_m[2] == pytest.approx(0.0, abs=0.03)
        assert t.radius_m == pytest.approx(true[2], abs=0.004)
        assert t.radius_height_m == pytest.approx(1.3)
        assert t.suitable


def test_one_sided_noisy_trunks_are_not_thinned() -> None:
    rng = np.random.default_rng(2)
    places = ((3.0, 0.0, 0.10), (0.0, 3.5, 0.16), (-4.0, 1.0, 0.08))
    parts = [trunk(x, y, r, rng, arc=facing(x, y), density=6000.0) for x, y, r in places]
    cloud = with_depth_noise(_scene(*parts), EYE, rng)
    trunks = detect_trees(cloud, views=_views(len(cloud))).trunks
    assert len(trunks) == 3
    for x, y, r in places:
        t = min(trunks, key=lambda t: float(np.hypot(t.base_m[0] - x, t.base_m[1] - y)))
        assert np.hypot(t.base_m[0] - x, t.base_m[1] - y) < 0.03
        assert t.radius_m == pytest.approx(r, abs=0.008)


@pytest.mark.parametrize("lean_deg", [10.0, 19.0, 24.0])
def test_leaning_trunk(lean_deg: float) -> None:
    rng = np.random.default_rng(3)
    slope = float(np.tan(np.radians(lean_deg)))
    cloud = _scene(trunk(1.0, 1.0, 0.10 / np.cos(np.radians(lean_deg)), rng, lean=(slope, 0.0)))
    trunks = detect_trees(cloud).trunks
    assert len(trunks) == 1
    assert np.degrees(trunks[0].lean_rad) == pytest.approx(lean_deg, abs=1.0)
    assert trunks[0].base_m[0] == pytest.approx(1.0, abs=0.03)
    assert trunks[0].suitable == (lean_deg < 20.0)


@pytest.mark.parametrize("gap", [0.15, 0.3])
def test_close_trunks_stay_apart(gap: float) -> None:
    rng = np.random.default_rng(4)
    xs = [2.0 + i * (0.2 + gap) for i in range(3)]
    cloud = _scene(*(trunk(x, 0.5, 0.10, rng) for x in xs))
    cloud += rng.normal(0.0, 0.004, cloud.shape)
    trunks = detect_trees(cloud).trunks
    assert sorted(t.base_m[0] for t in trunks) == pytest.approx(xs, abs=0.02)


def test_thick_trunk_is_listed_as_unsuitable() -> None:
    rng = np.random.default_rng(5)
    (t,) = detect_trees(_scene(trunk(2.0, 0.0, 0.40, rng))).trunks
    assert not t.suitable
    assert t.remark == "too thick"
    assert t.radius_m == pytest.approx(0.40, abs=0.01)


def test_bush_wall_and_table_legs_are_no_trees() -> None:
    rng = np.random.default_rng(6)
    legs = [trunk(x, y, 0.035, rng, height=0.75, density=8000.0) for x in (1.0, 2.4) for y in (-1.0, -0.2)]
    top = np.stack([rng.uniform(0.9, 2.5, 6000), rng.uniform(-1.1, -0.1, 6000), rng.normal(0.75, 0.004, 6000)], axis=1)
    result = detect_trees(_scene(bush(-2.0, 1.0, 0.6, 1.5, rng), wall(3.0, -2.0, 2.0, rng), *legs, top))
    assert result.trunks == ()


def test_post_is_rejected_only_where_the_space_above_was_seen() -> None:
    rng = np.random.default_rng(7)
    post = trunk(3.5, 0.0, 0.06, rng, height=1.8, arc=facing(3.5, 0.0))
    tree = trunk(3.5, 1.2, 0.10, rng, height=4.0, arc=facing(3.5, 1.2))
    cloud = _scene(post, tree)
    seen = detect_trees(cloud, views=_camera_views(len(cloud), 0.0))
    assert [round(t.base_m[1], 1) for t in seen.trunks] == [1.2]
    assert any("post" in r.reason for r in seen.rejections)
    away = detect_trees(cloud, views=_camera_views(len(cloud), np.pi))
    assert len(away.trunks) == 2, "nothing is known of the space above"


def test_empty_and_nan_clouds() -> None:
    assert detect_trees(np.zeros((0, 3))).trunks == ()
    assert detect_trees(np.full((10, 3), np.nan)).refused_points == 10
    rng = np.random.default_rng(8)
    cloud = _scene(trunk(2.0, 0.0, 0.1, rng))
    cloud[::100] = np.nan
    result = detect_trees(cloud)
    assert result.refused_points == len(cloud[::100])
    assert len(result.trunks) == 1


def test_up_may_point_anywhere() -> None:
    rng = np.random.default_rng(9)
    cloud = _scene(trunk(2.0, 0.5, 0.12, rng))
    (straight,) = detect_trees(cloud).trunks
    swapped = cloud[:, [1, 2, 0]]  # z becomes the second axis
    (turned,) = detect_trees(swapped, up=(0.0, 1.0, 0.0)).trunks
    x, y, z = straight.base_m
    assert turned.base_m == pytest.approx((y, z, x), abs=0.01)
    assert turned.axis == pytest.approx((straight.axis[1], straight.axis[2], straight.axis[0]), abs=0.01)
    assert turned.radius_m == pytest.approx(straight.radius_m, abs=0.002)


def test_large_coordinates_do_not_matter() -> None:
    rng = np.random.default_rng(10)
    cloud = _scene(trunk(2.0, 0.5, 0.12, rng))
    shift = np.array([470_000.0, 3_810_000.0, 2_280.0])
    (near,), (far,) = detect_trees(cloud).trunks, detect_trees(cloud + shift).trunks
    assert np.array(far.base_m) - shift == pytest.approx(np.array(near.base_m), abs=0.01)


def test_same_input_same_output() -> None:
    rng = np.random.default_rng(11)
    cloud = _scene(trunk(2.0, 0.5, 0.12, rng), bush(-1, -1, 0.5, 1.2, rng)).astype(np.float32)
    first, second = detect_trees(cloud), detect_trees(cloud.copy())
    assert first.trunks == second.trunks
    assert first.rejections == second.rejections


def test_a_fork_is_one_unsuitable_tree_and_neighbours_that_lean_apart_are_two() -> None:
    rng = np.random.default_rng(12)
    stem = trunk(2.0, 0.0, 0.14, rng, height=0.5)
    arms = [trunk(2.0 - s * 0.5, 0.0, 0.08, rng, low=0.5, lean=(s, 0.0)) for s in (0.27, -0.27)]
    (t,) = detect_trees(_scene(stem, *arms)).trunks
    assert not t.suitable
    assert t.remark.startswith("forks 0.")
    assert t.base_m[0] == pytest.approx(2.0, abs=0.05)
    apart = [trunk(2.0 - s, 0.0, 0.08, rng, lean=(s, 0.0)) for s in (0.27, -0.27)]  # they would meet 1 m under ground
    assert len(detect_trees(_scene(*apart)).trunks) == 2
