from __future__ import annotations

import numpy as np
import pytest

from services.detector.axis_fit import to_upright
from services.detector.config import DetectorConfig
from services.detector.detect import detect_trees
from services.detector.facing import common_eye, facing
from tests.unit.detector_clouds import Floats, ground, trunk, with_depth_noise
from tests.unit.detector_clouds import facing as arc_facing

EYE = np.array([0.0, 0.0, 1.5])
PLACES = ((3.0, 0.0, 0.10), (0.0, 3.5, 0.16), (-3.6, 1.0, 0.08), (1.5, -3.2, 0.12))


def _one_sided(seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    parts = [trunk(x, y, r, rng, arc=arc_facing(x, y), density=6000.0) for x, y, r in PLACES]
    return with_depth_noise(np.concatenate([ground(5.0), *parts]), EYE, rng)


@pytest.mark.parametrize("seed", [5, 6])
def test_one_sided_trunks_without_views_are_not_thinned(seed: int) -> None:
    trunks = detect_trees(_one_sided(seed)).trunks
    assert len(trunks) == len(PLACES)
    errors = []
    for x, y, r in PLACES:
        t = min(trunks, key=lambda t: float(np.hypot(t.base_m[0] - x, t.base_m[1] - y)))
        assert np.hypot(t.base_m[0] - x, t.base_m[1] - y) < 0.03
        errors.append(t.radius_m - r)
    assert np.sqrt(np.mean(np.square(errors))) < 0.007, "a radial fit is 1 to 2 cm thin here"


def _surface(arc: float, noise_m: float) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(1)
    a = rng.uniform(np.pi - arc, np.pi + arc, 2000)
    P = np.stack([0.1 * np.cos(a) + rng.normal(0.0, noise_m, 2000), 0.1 * np.sin(a), rng.uniform(-1, 1, 2000)], axis=1)
    return P, np.array([0.0, 0.0, 0.0, 0.0, 0.1, 0.0])


def test_a_face_tells_its_eye_and_its_noise() -> None:
    seen = facing(*_surface(1.4, 0.025))
    assert seen is not None
    assert seen.ray == pytest.approx([1.0, 0.0], abs=0.05)
    assert seen.noise_m == pytest.approx(0.025, rel=0.2)
    assert seen.range_m(0.002, 0.006) == pytest.approx(3.5, abs=0.5)


def test_a_whole_ring_and_a_clean_arc_tell_nothing() -> None:
    assert facing(*_surface(np.pi, 0.025)) is None
    assert facing(*_surface(1.4, 0.004)) is None


def test_faces_meet_in_one_eye_or_in_none() -> None:
    places = np.array([[3.0, 0.0], [0.0, 4.0], [-2.0, -2.0]])
    eye = np.array([0.3, -0.2])
    rays = (places - eye) / np.linalg.norm(places - eye, axis=1, keepdims=True)
    assert common_eye(places, rays, np.full(3, 3.0)) == pytest.approx(eye, abs=1e-6)
    row = np.array([[0.0, 3.0], [4.0, 3.0], [8.0, 3.0], [12.0, 3.0]])  # a walk past a row
    assert common_eye(row, np.tile([[0.0, 1.0]], (4, 1)), np.full(4, 3.0)) is None


def test_direction_is_turned_upright() -> None:
    R = np.empty((3, 3))
    to_upright(0.3, -0.2, R)
    assert pytest.approx(np.eye(3), abs=1e-12) == R @ R.T
    assert R @ (np.array([0.3, -0.2, 1.0]) / np.sqrt(1.13)) == pytest.approx([0.0, 0.0, 1.0], abs=1e-12)


def test_doubts_know_of_shape_and_drift() -> None:
    rng = np.random.default_rng(3)
    cloud = np.concatenate([ground(), trunk(2.0, 0.5, 0.15, rng, arc=arc_facing(2.0, 0.5))])
    plain, drifting = (detect_trees(cloud, config=DetectorConfig(map_drift_m=d)).trunks[0] for d in (0.0, 0.02))
    assert drifting.sigma_xy_m == pytest.approx(np.hypot(plain.sigma_xy_m, 0.02))
    assert drifting.sigma_radius_m == plain.sigma_radius_m
    assert plain.sigma_radius_m > 0.5 * DetectorConfig().out_of_round * 0.15, "more points do not make a side the whole"
    clean = DetectorConfig(out_of_round=0.0, off_centre=0.0, map_drift_m=0.0)
    round_one = detect_trees(cloud, config=clean).trunks[0]
    assert round_one.sigma_radius_m < plain.sigma_radius_m
    assert round_one.sigma_xy_m < plain.sigma_xy_m
