"""One joint fit per candidate: a leaning, tapering cylinder through all points of its slices.

Parameters: axis ``(x0, y0)`` at the reference height, its slopes, radius and taper. Points are sheared along the
current axis and the plan is stretched so that the cross-section of a leaning trunk is a circle again. Residuals along
the ray as in ``arcs``; robust Gauss-Newton (Tukey); the covariance is the inverse normal matrix times the observed scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.detector.config import DetectorConfig
from services.detector.cylinder_kernels import assess, fit_axis
from services.detector.model import Floats
from services.detector.stacks import Stack
from services.detector.voxels import Voxels

_PRIOR_SLOPE = 0.02
"""Standard deviation of the lean left over after the stack's line was taken out, metres per metre."""
_PRIOR_TAPER = 0.008
"""Standard deviation of the taper about its mean, metres of radius per metre of height."""
_MEAN_TAPER = -0.006
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
    at, slope = stack.at_m.copy(), stack.slope.copy()
    normal, x = np.zeros((6, 6)), np.zeros(6)
    start = 1.0 if voxels.seen_from else 3.0  # without views the noise is not known beforehand
    scale, P, U, G = fit_axis(
        voxels.xyz_m, voxels.ray_m, at, slope, stack.radius_m, _margin_m(stack, config), stack.z_low_m - 0.15,
        stack.z_high_m + 0.15, start, _CORRELATED, config.range_noise_per_m, config.surface_noise_m, _priors(stack.radius_m),
        normal, x,
    )  # fmt: skip
    return None if scale < 0.0 else _measured(P, U, G, x, float(scale), at, slope, normal, config)


def _measured(
    P: Floats, U: Floats, G: Floats, x: Floats, scale: float, at: Floats, slope: Floats, normal: Floats,
    config: DetectorConfig,
) -> Cylinder | None:  # fmt: skip
    on, counts = np.zeros(len(P), dtype=np.int64), np.zeros(8)
    z_low = float(P[:, 2].min())
    bands = np.zeros(int((P[:, 2].max() - z_low) / 0.1) + 1, dtype=np.int64)
    assess(P, U, G, x, scale, config.range_noise_per_m, config.surface_noise_m, on, counts, bands, z_low)
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
