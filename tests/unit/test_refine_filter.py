"""The Kalman filters are as sure as they are right: NIS and NEES against their expectations, gating, and giving up."""

from __future__ import annotations

import numpy as np
import pytest

from services.detector.refine.config import FilterConfig
from services.detector.refine.kalman import Filter1D, TargetFilter

CONFIG = FilterConfig()
VARIANCES = (4.0, 64e-6, 16e-6)
TRUE = (320.0, 2.0, 0.10)
DT_S = 1.0 / 15.0


def _run(seed: int, steps: int = 150) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 3) NIS and (N, 3) NEES where measurements have a constant and a white part, as the filter is told."""
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(VARIANCES)
    constant = rng.normal(0.0, sigma * np.sqrt(1.0 - CONFIG.white_share))
    jitter = np.array([500.0 * CONFIG.pose_step_rad, CONFIG.pose_step_m])
    filters: TargetFilter | None = None
    nis, nees = [], []
    for _ in range(steps):
        z = np.array(TRUE) + constant + rng.normal(0.0, sigma * np.sqrt(CONFIG.white_share))
        values = (float(z[0]), float(z[1]), float(z[2]))
        if filters is None:
            filters = TargetFilter(values, VARIANCES, CONFIG)
            continue
        # what is told of the camera's motion is wrong by its own jitter; a later pose knows nothing of that
        filters.predict(DT_S, tuple(rng.normal(0.0, jitter)), 500.0)
        assert filters.update(values, VARIANCES)
        nis.append(filters.innovations2)
        nees.append((np.array(filters.values) - TRUE) ** 2 / np.array(filters.variances))
    return np.array(nis), np.array(nees)


def test_innovations_and_errors_are_as_large_as_told() -> None:
    runs = [_run(seed) for seed in range(30)]
    nis = np.mean([r[0][30:] for r in runs], axis=(0, 1))
    nees = np.mean([r[1][30:] for r in runs], axis=(0, 1))
    # image x and range: process noise for turns that this camera does not make keeps them on the safe side
    assert np.all(nis > 0.3)
    assert np.all(nis < 1.3)
    # 30 constants drawn: chi-square of 30 over 30 lies within 0.45..1.75 in 99.5 of 100
    assert np.all(nees > 0.4)
    assert np.all(nees < 1.8)


def test_a_smoothed_radius_jitters_less_than_the_raw_one() -> None:
    rng = np.random.default_rng(2)
    raw = 0.1 + rng.normal(0.0, 0.002, 200)
    filters = TargetFilter((320.0, 2.0, float(raw[0])), (4.0, 64e-6, 4e-6 / CONFIG.white_share), CONFIG)
    smooth = []
    for value in raw[1:]:
        filters.predict(DT_S, (0.0, 0.0), 500.0)
        filters.update((320.0, 2.0, float(value)), (4.0, 64e-6, 4e-6 / CONFIG.white_share))
        smooth.append(filters.values[2])
    assert np.std(np.diff(smooth)) < 0.3 * np.std(np.diff(raw))


def test_a_wild_measurement_is_refused_as_a_whole_and_three_in_a_row_start_anew() -> None:
    filters = TargetFilter(TRUE, VARIANCES, CONFIG)
    before = filters.values
    for k in range(CONFIG.restart_after):
        assert not filters.hopeless
        assert not filters.update((TRUE[0], TRUE[1] + 0.5, TRUE[2]), VARIANCES), k
    assert filters.hopeless
    assert filters.values == before


def test_without_a_pose_the_filter_follows_a_turn_that_it_was_not_told_of() -> None:
    filters = TargetFilter(TRUE, VARIANCES, CONFIG)
    accepted = 0
    for k in range(1, 20):
        filters.predict(DT_S, None, 500.0)
        accepted += filters.update((TRUE[0] + 20.0 * k * DT_S * min(k, 5), TRUE[1], TRUE[2]), VARIANCES)
    assert accepted >= 16


def test_prediction_carries_value_and_rate() -> None:
    one = Filter1D(1.0, 0.01, 0.01)
    for k in range(40):
        one.predict(0.1, 0.0, 0.0, 0.01)
        one.update(1.0 + 0.05 * (k + 1), 1e-4)
    one.predict(1.0, 0.25, 0.0, 0.01)
    assert one.value == pytest.approx(1.0 + 2.0 + 0.5 + 0.25, abs=0.05)
