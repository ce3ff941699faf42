"""One joint fit per candidate: a leaning, tapering cylinder through all points of its slices.

Parameters: axis ``(x0, y0)`` at the reference height, its slopes, radius and taper. Points are sheared along the
current axis and the plan is stretched so that the cross-section of a leaning trunk is a circle again. Residuals along
the ray as in ``arcs``; robust Gauss-Newton (Tukey); the covariance is the inverse normal matrix times the observed scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from services.common.geometry import rotation_aligning
from services.detector.arcs import BINS
from services.detector.config import DetectorConfig
from services.detector.model import Floats, Ints
from services.detector.ray import point_sigma, residual, solve
from services.detector.stacks import Stack
from services.detector.voxels import Voxels

_PRIOR_SLOPE = 0.02
"""Standard deviation of the lean left over after the stack's line was taken out, metres per metre."""
_PRIOR_TAPER = 0.008
"""Standard deviation of the taper about its mean, metres of radius per metre of height."""
_MEAN_TAPER = -0.006
_MOST = (600, 2500)
"""Points that the first and the second turn of a fit use at most."""
_CORRELATED = 25.0
"""Neighbouring points share fixed-pattern noise and bark: so many of them count as one in the covariance."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A fitted trunk in the upright frame."""

    at_m: Floats
    """(3,): a point of the axis, at the middle of the points."""
    axis: Floats
    """(3,), unit, upward."""
    radius_m: float
    """At ``at_m``."""
    taper: float
    """Change of radius per metre along the axis."""
    noise_m: float
    scale: float
    """Observed over expected noise."""
    points: int
    inside: int
    fill: float
    """Density of points near the axis (within 0.6 radius) over that at the surface: 0 for a clean trunk, 1 in a bush."""
    around: int
    """Points within 10 cm outside the surface."""
    arc_rad: float
    z_low_m: float
    z_high_m: float
    cover: float
    """Share of 10 cm bands between low and high with points on the surface."""
    range_m: float
    """Mean distance it was seen from, 0 where views are unknown."""
    covariance: Floats
    """(6, 6) of x, y (at ``at_m``), the two slopes, radius, taper."""


@njit(cache=True, nogil=True)
def _near(
    xyz: Floats, x: float, y: float, z: float, sx: float, sy: float, reach: float, z0: float, z1: float, out: Ints
) -> int:
    n = 0
    for i in range(xyz.shape[0]):
        if not z0 <= xyz[i, 2] <= z1:
            continue
        dz = xyz[i, 2] - z
        dx, dy = xyz[i, 0] - x - sx * dz, xyz[i, 1] - y - sy * dz
        if dx * dx + dy * dy < reach * reach:
            out[n] = i
            n += 1
    return n


@njit(cache=True, nogil=True)
def _residuals(
    P: Floats, U: Floats, G: Floats, x: Floats, k_range: float, surface: float, e: Floats, sigma: Floats
) -> None:
    """Write each point's residual as a share of its expected noise, and that noise."""
    J = np.empty(3)
    for i in range(P.shape[0]):
        z = P[i, 2]
        cx, cy, r = x[0] + x[2] * z, x[1] + x[3] * z, max(x[4] + x[5] * z, 0.005)
        s = ((cx - P[i, 0]) * U[i, 1] - (cy - P[i, 1]) * U[i, 0]) / r
        sigma[i] = point_sigma(s, G[i], U[i, 0] != 0.0 or U[i, 1] != 0.0, k_range, surface)
        e[i] = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], cx, cy, r, J) / sigma[i]


@njit(cache=True, nogil=True)
def _robust_scale(e: Floats, scale: float) -> float:
    """Return the spread of the residuals near zero (median absolute deviation), at least 1; -1 when too few are near."""
    near = 0
    size = np.empty(e.shape[0])
    for i in range(e.shape[0]):
        if abs(e[i]) < 4.5 * scale:
            size[near] = abs(e[i])
            near += 1
    return max(1.0, 1.4826 * np.median(size[:near])) if near >= 10 else -1.0


@njit(cache=True, nogil=True)
def _normal_equations(
    P: Floats, U: Floats, weight: float, x: Floats, e: Floats, sigma: Floats, scale: float, A: Floats, y: Floats
) -> None:
    """Sum the weighted normal matrix and its right side."""
    J, K = np.empty(3), np.empty(6)
    A[:] = 0.0
    y[:] = 0.0
    for i in range(P.shape[0]):
        t = e[i] / (4.0 * scale)
        if abs(t) >= 1.0:
            continue
        z = P[i, 2]
        residual(
            P[i, 0], P[i, 1], U[i, 0], U[i, 1], x[0] + x[2] * z, x[1] + x[3] * z, max(x[4] + x[5] * z, 0.005), J
        )  # fmt: skip
        K[0], K[1], K[2], K[3], K[4], K[5] = J[0], J[1], J[0] * z, J[1] * z, J[2], J[2] * z
        w = weight * (1.0 - t * t) ** 2 / (scale * scale * sigma[i])
        for a in range(6):
            y[a] -= w * e[i] * K[a]
            for b in range(a + 1):
                A[a, b] += w * K[a] * K[b] / sigma[i]
    for a in range(6):
        for b in range(a):
            A[b, a] = A[a, b]


@njit(cache=True, nogil=True)
def _fit(
    P: Floats, U: Floats, G: Floats, weight: float, x: Floats, k_range: float, surface: float, start: float,
    prior: Floats, normal: Floats,
) -> float:  # fmt: skip
    """Improve ``x`` = (cx, cy, slope x, slope y, radius, taper) in the axis frame; return the scale factor.

    ``prior`` (6, 2) holds mean and inverse variance of each parameter; ``normal`` receives the normal matrix.
    """
    A, y, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    e, sigma = np.empty(P.shape[0]), np.empty(P.shape[0])
    scale = start
    for _ in range(15):
        _residuals(P, U, G, x, k_range, surface, e, sigma)
        scale = _robust_scale(e, scale)
        if scale < 0.0:
            return -1.0
        _normal_equations(P, U, weight, x, e, sigma, scale, A, y)
        for a in range(6):
            A[a, a] += prior[a, 1]
            y[a] += prior[a, 1] * (prior[a, 0] - x[a])
        normal[:] = A
        solve(A, y, step)
        size = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[4] ** 2)
        limit = min(1.0, 0.3 * x[4] / max(size, 1e-12))
        for a in range(6):
            x[a] += limit * step[a]
        x[4] = max(x[4], 0.008)
        if size < 5e-5:
            break
    return scale


@njit(cache=True, nogil=True)
def _assess(
    P: Floats, U: Floats, G: Floats, x: Floats, scale: float, k_range: float, surface: float, on: Ints, counts: Floats,
    bands: Ints, z_low: float,
) -> None:  # fmt: skip
    """Fill counts: on, inside, around, arc, noise, mean range, core, skin. Mark the points on the surface; count them per band."""
    bins = np.zeros(BINS)
    J = np.empty(3)
    counts[:] = 0.0
    for i in range(P.shape[0]):
        z = P[i, 2]
        cx, cy, r = x[0] + x[2] * z, x[1] + x[3] * z, max(x[4] + x[5] * z, 0.005)
        dx, dy = P[i, 0] - cx, P[i, 1] - cy
        ray = U[i, 0] != 0.0 or U[i, 1] != 0.0
        s = (dy * U[i, 0] - dx * U[i, 1]) / r
        sigma = scale * point_sigma(s, G[i], ray, k_range, surface)
        e = residual(P[i, 0], P[i, 1], U[i, 0], U[i, 1], cx, cy, r, J)
        d = np.sqrt(dx * dx + dy * dy)
        if d < 0.6 * r:
            counts[6] += 1
        elif 0.8 * r < d < 1.2 * r:
            counts[7] += 1
        on[i] = 0
        if abs(e) < 3.0 * sigma:
            on[i] = 1
            counts[0] += 1
            counts[4] += e * e
            counts[5] += G[i]
            bins[min(BINS - 1, int((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * BINS))] += 1.0
            band = int((z - z_low) / 0.1)
            if 0 <= band < bands.shape[0]:
                bands[band] += 1
        elif d < r:
            counts[1] += 1
        elif d < r + 0.1:
            counts[2] += 1
    few = 0.02 * counts[0] / 10.0
    for b in range(BINS):
        if bins[b] > few:
            counts[3] += 2.0 * np.pi / BINS
    if counts[0] > 0:
        counts[4] = np.sqrt(counts[4] / counts[0])
        counts[5] /= counts[0]


def _axis_frame(voxels: Voxels, near: Ints, at: Floats, R: Floats) -> tuple[Floats, Floats, Floats]:
    """Return points, unit rays in the plan and ranges of the near voxels in the frame whose z is the axis."""
    P = (voxels.xyz_m[near] - at) @ R.T
    ray = voxels.ray_m[near]
    G = np.sqrt((ray**2).sum(axis=1))
    flat = (ray @ R.T)[:, :2]
    length = np.sqrt((flat**2).sum(axis=1, keepdims=True))
    U = np.where(length > 1e-6, flat / np.maximum(length, 1e-9), 0.0)
    return np.ascontiguousarray(P), np.ascontiguousarray(U), G


def _priors(radius: float) -> Floats:
    """Return mean and inverse variance of (x, y, slope x, slope y, radius, taper) in the axis frame of a candidate."""
    slope = 1.0 / (4 * _PRIOR_SLOPE) ** 2
    return np.array([
        [0.0, 1e-6], [0.0, 1e-6], [0.0, slope], [0.0, slope], [radius, 1.0 / (0.12 * radius + 0.006) ** 2],
        [_MEAN_TAPER, 1.0 / _PRIOR_TAPER**2],
    ])  # fmt: skip


def _margin_m(stack: Stack, config: DetectorConfig) -> float:
    """Return how far outside the surface points may belong to it: by the sensor's noise, where the range is known.

    Wider, and the neighbour's points (a bush, the other arm of a fork) pull the fit.
    """
    if stack.range_m == 0.0:
        return max(0.12, 0.4 * stack.radius_m)
    return 0.04 + 0.1 * stack.radius_m + 2.5 * config.range_noise_per_m * stack.range_m**2


def fit_cylinder(voxels: Voxels, stack: Stack, config: DetectorConfig) -> Cylinder | None:
    """Return the joint fit of a candidate, or None when too few points remain or it leaves its slices."""
    at, slope, radius = stack.at_m.copy(), stack.slope.copy(), stack.radius_m
    prior, normal = _priors(radius), np.zeros((6, 6))
    buffer = np.empty(len(voxels.xyz_m), dtype=np.int64)
    x = np.array([0.0, 0.0, 0.0, 0.0, radius, _MEAN_TAPER])
    P = U = np.zeros((0, 3))
    G = np.zeros(0)
    scale = 1.0 if voxels.seen_from else 3.0  # without views the noise is not known beforehand
    for turn in range(2):
        reach = radius + _margin_m(stack, config)
        z0, z1 = stack.z_low_m - 0.15, stack.z_high_m + 0.15
        n = int(_near(voxels.xyz_m, at[0], at[1], at[2], slope[0], slope[1], reach, z0, z1, buffer))
        if n < 15:
            return None
        R = rotation_aligning((slope[0], slope[1], 1.0), (0.0, 0.0, 1.0))
        every = 1 + n // _MOST[turn]
        P, U, G = _axis_frame(voxels, buffer[:n:every], at, R)
        x[:4] = 0.0
        weight, k_range, surface = every / _CORRELATED, config.range_noise_per_m, config.surface_noise_m
        scale = float(_fit(P, U, G, weight, x, k_range, surface, scale, prior, normal))
        if scale < 0.0 or not 0.01 <= x[4] <= 1.5:
            return None
        at = at + R.T @ np.array([x[0], x[1], 0.0])
        axis = R.T @ np.array([x[2], x[3], 1.0])
        slope, radius = axis[:2] / axis[2], float(x[4])
        if np.hypot(*slope) > 1.5 or abs(radius - stack.radius_m) > 0.35 * stack.radius_m + 0.01:
            return None
    return _measured(P, U, G, x, scale, at, slope, normal, config)


def _girth_correction(P: Floats, x: Floats) -> float:
    """Return what to add to the radius so that every direction counts alike, not every point.

    Trunks are not round and scans are denser on one side; a tape goes round all sides. Mean over 36 sectors of the
    median residual; sectors with fewer than 8 points count as the fitted circle.
    """
    z = P[:, 2]
    dx, dy = P[:, 0] - x[0] - x[2] * z, P[:, 1] - x[1] - x[3] * z
    e = np.hypot(dx, dy) - (x[4] + x[5] * z)
    sector = ((np.arctan2(dy, dx) + np.pi) / (2.0 * np.pi) * BINS).astype(np.int64) % BINS
    near = np.abs(e) < min(0.08, 0.5 * x[4])
    total = 0.0
    for b in range(BINS):
        own = e[near & (sector == b)]
        total += float(np.median(own)) if len(own) >= 8 else 0.0
    return total / BINS


def _measured(
    P: Floats, U: Floats, G: Floats, x: Floats, scale: float, at: Floats, slope: Floats, normal: Floats,
    config: DetectorConfig,
) -> Cylinder | None:  # fmt: skip
    on, counts = np.zeros(len(P), dtype=np.int64), np.zeros(8)
    z_low = float(P[:, 2].min())
    bands = np.zeros(int((P[:, 2].max() - z_low) / 0.1) + 1, dtype=np.int64)
    _assess(P, U, G, x, scale, config.range_noise_per_m, config.surface_noise_m, on, counts, bands, z_low)
    if not U.any():
        x[4] += _girth_correction(P, x)
    held = np.flatnonzero(bands >= 3)
    if len(held) == 0:
        return None
    axis = np.array([slope[0], slope[1], 1.0]) / np.sqrt(1.0 + float(slope @ slope))
    low, high = z_low + 0.1 * held[0], min(z_low + 0.1 * (held[-1] + 1), float(P[:, 2].max()))
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return Cylinder(
        at_m=at, axis=axis, radius_m=float(x[4]), taper=float(x[5]), noise_m=float(counts[4]), scale=scale,
        points=int(counts[0]), inside=int(counts[1]), around=int(counts[2]),
        fill=float(counts[6] / 0.36 / max(counts[7] / 0.8, 1.0)), arc_rad=min(float(counts[3]), 2.0 * np.pi),
        z_low_m=float(at[2] + low * axis[2]), z_high_m=float(at[2] + high * axis[2]),
        cover=len(held) / (held[-1] - held[0] + 1), range_m=float(counts[5]), covariance=covariance,
    )  # fmt: skip
