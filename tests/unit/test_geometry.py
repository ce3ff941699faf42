from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.common import geometry as g

vectors = st.tuples(*[st.floats(-3.0, 3.0)] * 3).filter(lambda v: np.linalg.norm(v) < np.pi - 1e-3)


@given(vectors)
def test_log_inverts_exp(v: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(g.log_rotation(g.exp_rotation(v)), v, atol=1e-9)


@given(vectors)
def test_quaternion_round_trip(v: tuple[float, float, float]) -> None:
    R = g.exp_rotation(v)
    np.testing.assert_allclose(g.rotation_from_quaternion(g.quaternion_from_rotation(R)), R, atol=1e-12)


@given(vectors, vectors)
def test_alignment_turns_one_direction_into_the_other(
    a: tuple[float, float, float], b: tuple[float, float, float]
) -> None:
    if np.linalg.norm(a) < 1e-3 or np.linalg.norm(b) < 1e-3:
        return
    u, v = np.array(a) / np.linalg.norm(a), np.array(b) / np.linalg.norm(b)
    R = g.rotation_aligning(a, b)
    np.testing.assert_allclose(R @ u, v, atol=1e-9)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("opposite", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_alignment_of_opposite_directions(opposite: tuple[float, float, float]) -> None:
    R = g.rotation_aligning(opposite, -np.array(opposite))
    np.testing.assert_allclose(R @ opposite, -np.array(opposite), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


def test_level_camera_looks_along_its_heading() -> None:
    T = g.level_camera((1.0, 2.0, 3.0), np.pi / 2)
    np.testing.assert_allclose(T[:3, 2], (0.0, 1.0, 0.0), atol=1e-12)  # optical axis to the left
    np.testing.assert_allclose(T[:3, 1], (0.0, 0.0, -1.0), atol=1e-12)  # image y points down
    assert g.camera_yaw(T) == pytest.approx(np.pi / 2)


def test_inverse_and_apply() -> None:
    T = g.pose(g.exp_rotation((0.1, -0.4, 0.8)), (1.0, 2.0, -3.0))
    points = np.random.default_rng(1).normal(size=(20, 3))
    np.testing.assert_allclose(g.apply(g.inverse(T), g.apply(T, points)), points, atol=1e-12)


def test_orthonormal_repairs_a_drifted_rotation() -> None:
    R = g.exp_rotation((0.3, 0.2, -0.5))
    repaired = g.orthonormal(R + 1e-3 * np.random.default_rng(2).normal(size=(3, 3)))
    np.testing.assert_allclose(repaired @ repaired.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(repaired, R, atol=5e-3)
    assert np.linalg.det(g.orthonormal(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)


@given(st.floats(-100.0, 100.0))
def test_wrap_angle_stays_in_range_and_keeps_the_direction(angle: float) -> None:
    wrapped = g.wrap_angle(angle)
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)
