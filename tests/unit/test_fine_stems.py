"""Stems measured along their height from the points of all frames."""

from __future__ import annotations

import numpy as np
import pytest

from services.fine.config import FineConfig
from services.fine.model import Stem, StemPoints
from services.fine.stems import measure_stem
from services.fine.taper import agreed, fit_taper, jackknife_sigma
from tests.unit.fine_scene import ConeStem, seen_from

CONFIG = FineConfig()
# an approach of 40 frames from the origin's side, height 1.5 m
ORIGINS = np.stack([np.linspace(0.0, 1.0, 40), np.linspace(-0.3, 0.3, 40), np.full(40, 1.5)], axis=1)


def measured(stem: ConeStem, seed: int, error: float = 0.01, per_frame: int = 1500) -> Stem:
    points, frames = seen_from(stem, ORIGINS, per_frame, seed)
    found = measure_stem(stem.tree(error), StemPoints(4, points, frames), ORIGINS, CONFIG)
    assert found is not None
    return found


@pytest.mark.parametrize("d", [0.08, 0.24, 0.38])
def test_diameter_taper_and_place_of_a_leaning_stem_seen_from_one_side(d: float) -> None:
    stem = ConeStem(d=d, taper=-0.06 * d)
    found = measured(stem, seed=round(100 * d))
    assert found.diameter_13_m == pytest.approx(d, abs=0.003)
    assert found.taper_m_per_m == pytest.approx(-0.06 * d, abs=0.004)
    assert found.height_m == 1.3
    assert np.hypot(found.base_m[0] - stem.x, found.base_m[1] - stem.y) < 0.004
    assert found.axis[0] / found.axis[2] == pytest.approx(0.04, abs=0.003)


def test_a_section_every_ten_centimetres_with_its_doubt() -> None:
    stem = ConeStem()
    found = measured(stem, seed=1)
    heights = np.array([s.height_m for s in found.sections])
    assert np.allclose(np.diff(heights), CONFIG.step_m)
    assert heights[0] == pytest.approx(0.2)
    assert heights[-1] >= 2.4
    truth = stem.diameter(heights)
    errors = np.array([s.diameter_m for s in found.sections]) - truth
    assert np.abs(errors).max() < 0.008
    sigmas = np.array([s.sigma_m for s in found.sections])
    assert np.mean(np.abs(errors) < 2.0 * sigmas) > 0.8
    assert not any(s.used for s in found.sections if s.height_m < CONFIG.flare_m - 1e-9)
    assert all(s.arc_rad > 1.5 for s in found.sections)


def test_the_doubt_covers_the_error_and_shrinks_with_what_is_seen() -> None:
    ratios = []
    for seed in range(6):
        found = measured(ConeStem(), seed=10 + seed)
        ratios.append((found.diameter_13_m - 0.24) / found.sigma_13_m)
        assert found.sigma_13_m < 0.012
    assert np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_branches_and_flare_do_not_pull_the_taper_function() -> None:
    stem = ConeStem()
    points, frames = seen_from(stem, ORIGINS, 1500, 3)
    whorl = (points[:, 2] > 1.75) & (points[:, 2] < 2.05)
    away = points[:, :2] - stem.centre(points[:, 2].astype(float))[:, :2]
    points[whorl, :2] += (0.25 * away[whorl]).astype(np.float32)
    points[points[:, 2] < 0.35, :2] += (0.2 * away[points[:, 2] < 0.35]).astype(np.float32)
    found = measure_stem(stem.tree(), StemPoints(4, points, frames), ORIGINS, CONFIG)
    assert found is not None
    assert found.diameter_13_m == pytest.approx(0.24, abs=0.004)
    dropped = {round(s.height_m, 1) for s in found.sections if not s.used}
    assert {0.2, 0.3} <= dropped
    assert dropped & {1.8, 1.9, 2.0}


def test_too_little_seen_gives_none() -> None:
    stem = ConeStem()
    points, frames = seen_from(stem, ORIGINS[:2], 60, 3)
    assert measure_stem(stem.tree(), StemPoints(4, points, frames), ORIGINS, CONFIG) is None
    nothing = StemPoints(4, np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.int32))
    assert measure_stem(stem.tree(), nothing, ORIGINS, CONFIG) is None
    rng = np.random.default_rng(2)
    bush = rng.uniform(-0.4, 0.4, (5000, 3)) + np.array([2.0, 0.3, 1.3])
    cloud = StemPoints(4, bush.astype(np.float32), np.zeros(5000, dtype=np.int32))
    found = measure_stem(stem.tree(), cloud, ORIGINS, CONFIG)
    assert found is None or found.sigma_13_m >= 0.0  # no exception, whatever it is


def test_a_stem_seen_only_above_breast_height_is_told_there() -> None:
    stem = ConeStem()
    points, frames = seen_from(stem, ORIGINS, 3000, 5)
    high = points[:, 2] > 1.7
    found = measure_stem(stem.tree(), StemPoints(4, points[high], frames[high]), ORIGINS, CONFIG)
    assert found is not None
    assert found.height_m == pytest.approx(1.75, abs=0.1)
    assert found.diameter_13_m == pytest.approx(float(stem.diameter(np.array(found.height_m))), abs=0.005)


def test_taper_of_exact_sections_is_exact_and_one_wild_one_is_left_out() -> None:
    height = np.arange(0.4, 2.5, 0.1)
    radius = 0.12 - 0.006 * (height - 1.3)
    weight = np.full(len(height), 1.0 / 0.001**2)
    radius[7] += 0.05
    line, used = fit_taper(height, radius, weight)
    assert line == pytest.approx([0.12, -0.006], abs=1e-5)
    assert list(np.flatnonzero(~used)) == [7]


def test_the_live_radius_counts_as_much_as_it_is_sure() -> None:
    shift, sigma = agreed(0.100, 0.004, 0.108, 0.004)
    assert shift == pytest.approx(0.004)
    assert sigma == pytest.approx(0.004)  # no surer than either: they share frames
    shift, sigma = agreed(0.100, 0.002, 0.108, 0.020)
    assert abs(shift) < 0.0002
    assert 0.002 <= sigma < 0.0021


def test_jackknife_of_a_mean_is_its_standard_error() -> None:
    values = np.random.default_rng(1).normal(size=10)
    left_out = np.array([np.delete(values, k).mean() for k in range(10)])
    assert jackknife_sigma(left_out) == pytest.approx(values.std(ddof=1) / np.sqrt(10))
