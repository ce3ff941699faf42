"""Keyframes whose poses err: what each shows of a trunk lies beside what the others show, and must not thicken it."""

from __future__ import annotations

import numpy as np
import pytest

from services.detector.config import DetectorConfig
from services.detector.detect import detect_trees
from services.detector.model import Views

RADIUS_M = 0.10


def _cloud(seed: int, pose_noise_m: float) -> tuple[np.ndarray, Views]:
    """Return ground and a trunk at (3, 0), seen by eight keyframes at the origin, each shifted by its own error."""
    rng = np.random.default_rng(seed)
    points, index = [], []
    for k in range(8):
        angle, height = rng.uniform(np.pi - 1.2, np.pi + 1.2, 2500), rng.uniform(0.0, 3.0, 2500)
        trunk = np.stack([3.0 + RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), height], axis=1)
        ray = trunk - [0.0, 0.0, 1.5]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        trunk += ray * rng.normal(0.0, 0.018, (len(trunk), 1))
        trunk[:, :2] += rng.normal(0.0, pose_noise_m, 2)
        ground = np.column_stack(
            [rng.uniform(0.0, 5.0, 1500), rng.uniform(-2.0, 2.0, 1500), rng.normal(0.0, 0.01, 1500)]
        )
        points += [trunk, ground]
        index.append(np.full(4000, k, dtype=np.int32))
    return np.concatenate(points), Views(np.concatenate(index), np.tile([0.0, 0.0, 1.5], (8, 1)))


def _radius_errors(config: DetectorConfig) -> list[float]:
    errors = []
    for seed in range(4):
        trunks = detect_trees(*_shuffled(_cloud(seed, 0.012)), config=config).trunks
        assert len(trunks) == 1
        errors.append(trunks[0].radius_m - RADIUS_M)
    return errors


def _shuffled(cloud: tuple[np.ndarray, Views]) -> tuple[np.ndarray, tuple[float, float, float], Views]:
    points, views = cloud
    order = np.random.default_rng(9).permutation(len(points))
    return points[order], (0.0, 0.0, 1.0), Views(views.index[order], views.origins_m)


def test_errors_of_keyframe_poses_do_not_thicken_a_trunk() -> None:
    assert abs(np.mean(_radius_errors(DetectorConfig()))) < 0.003
    as_one_ring = _radius_errors(DetectorConfig(view_noise_m=1e-6))
    assert np.mean(as_one_ring) > 0.004, "fitted as one ring it is thicker: what this guards against"


def test_sigma_tells_of_the_errors_of_poses() -> None:
    few = detect_trees(*_shuffled(_cloud(1, 0.0)), config=DetectorConfig(map_drift_m=0.0)).trunks[0]
    sure = detect_trees(*_shuffled(_cloud(1, 0.0)), config=DetectorConfig(map_drift_m=0.0, view_noise_m=1e-6)).trunks[0]
    assert few.sigma_xy_m > sure.sigma_xy_m


def test_points_of_equal_origin_share_a_view() -> None:
    views = Views.of_points(np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    assert len(views.origins_m) == 2
    assert views.origins_m[views.index] == pytest.approx(np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))
