from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.common.kernels import solve_positive
from services.detector.arcs import fit_slices
from services.detector.band import Band
from services.detector.config import DetectorConfig
from services.detector.model import Views
from services.detector.ray import RIM, point_sigma, residual
from services.detector.upright import upright_frame
from services.detector.voxels import slice_clusters

angles = st.floats(-3.1, 3.1)


@given(angle=angles, offset=st.floats(-0.2, 0.2), heading=angles, radius=st.floats(0.03, 0.3), radial=st.booleans())
@settings(max_examples=200, deadline=None)
def test_residual_derivatives_are_right(
    angle: float, offset: float, heading: float, radius: float, radial: bool
) -> None:
    d = radius + offset * radius
    p = np.array([d * np.cos(angle), d * np.sin(angle)])
    u = np.zeros(2) if radial else np.array([np.cos(heading), np.sin(heading)])
    c = np.array([0.01, -0.02, radius])
    side = abs((c[0] - p[0]) * u[1] - (c[1] - p[1]) * u[0])
    if abs(side - RIM * radius) < 1e-4 or (not radial and side < 1e-4):
        return  # the derivative bends at the rim, and |s| at the axis
    J, dummy = np.empty(3), np.empty(3)
    residual(p[0], p[1], u[0], u[1], c[0], c[1], c[2], J)
    for k in range(3):
        step = np.zeros(3)
        step[k] = 1e-7
        up, down = c + step, c - step
        change = residual(p[0], p[1], u[0], u[1], up[0], up[1], up[2], dummy)
        change -= residual(p[0], p[1], u[0], u[1], down[0], down[1], down[2], dummy)
        assert J[k] == pytest.approx(change / 2e-7, rel=1e-3, abs=1e-4)


def test_residual_is_the_way_along_the_ray_to_the_surface() -> None:
    J = np.empty(3)
    # a ray along x at half the radius: the surface stands at -sqrt(0.1^2 - 0.05^2)
    t = residual(-0.2, 0.05, 1.0, 0.0, 0.0, 0.0, 0.1, J)
    assert -0.2 + t == pytest.approx(-np.sqrt(0.1**2 - 0.05**2))
    assert residual(0.13, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, J) == pytest.approx(0.03)


def test_residual_is_continuous_at_the_rim() -> None:
    J = np.empty(3)
    inner, outer = (residual(-0.2, RIM * 0.1 + e, 1.0, 0.0, 0.0, 0.0, 0.1, J) for e in (-1e-9, 1e-9))
    assert inner == pytest.approx(outer, abs=1e-7)


def test_noise_grows_with_range_and_slant() -> None:
    ray = True
    assert point_sigma(0.0, 5.0, ray, 0.002, 0.006) > point_sigma(0.0, 2.0, ray, 0.002, 0.006)
    assert point_sigma(0.9, 2.0, ray, 0.002, 0.006) > point_sigma(0.0, 2.0, ray, 0.002, 0.006)
    assert point_sigma(0.0, 5.0, not ray, 0.002, 0.006) == pytest.approx(0.006)


def test_solve_small_system() -> None:
    rng = np.random.default_rng(2)
    M = rng.normal(size=(6, 6))
    A = M @ M.T + np.eye(6)
    want = rng.normal(size=6)
    y, x = A @ want, np.empty(6)
    solve_positive(A.copy(), y, x)
    assert x == pytest.approx(want)


def _one_slice(noise_m: float, seed: int, rays: bool) -> float:
    """Return the mean radius error over layers of a one-sided arc of 10 cm seen from 4 m."""
    rng = np.random.default_rng(seed)
    n, layers = 120, 15
    xyz = []
    for layer in range(layers):
        a = rng.uniform(np.pi - 1.1, np.pi + 1.1, n)
        surface = np.stack([4.0 + 0.1 * np.cos(a), 0.1 * np.sin(a)], axis=1)
        unit = surface / np.linalg.norm(surface, axis=1, keepdims=True)
        p = surface + unit * rng.normal(0.0, noise_m, (n, 1))
        z = np.full((n, 1), 0.05 + 0.1 * layer)
        xyz.append(np.hstack([p, z]))
    points = np.concatenate(xyz)
    frame = upright_frame(points, (0.0, 0.0, 1.0))
    views = Views.of_points(points * [0.0, 0.0, 1.0]) if rays else None
    seen_by = views.index if views is not None else np.zeros(0, dtype=np.int32)
    band = Band(frame.xyz_m, seen_by, (0.0, 1.5), np.zeros((0, 3), dtype=np.float32))
    slices = slice_clusters(frame, band, views, 0.1, 0.05, 0.001)
    config = DetectorConfig(range_noise_per_m=noise_m / 16.0, surface_noise_m=0.004)
    circles = fit_slices(slices, frame.low, config)
    assert len(circles.layer) >= layers // 2
    return float(np.median(circles.radius_m)) - 0.1


def test_residuals_along_the_ray_do_not_thin_a_noisy_arc() -> None:
    assert abs(np.mean([_one_slice(0.015, s, rays=True) for s in range(4)])) < 0.008
    radial = np.mean([_one_slice(0.015, s, rays=False) for s in range(4)])
    assert radial < -0.008, "the radial fit is the biased one this guards against"
