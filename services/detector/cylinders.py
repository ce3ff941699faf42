"""One joint fit per candidate: a leaning, tapering cylinder through all points of its slices.

Parameters: axis ``(x0, y0)`` at the reference height, its slopes, radius and taper. Points are sheared along the
current axis and the plan is stretched so that the cross-section of a leaning trunk is a circle again. Residuals along
the ray as in ``arcs``; robust Gauss-Newton (Tukey); the covariance is the inverse normal matrix times the observed scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from services.detector.axis_fit import fit_axis
from services.detector.config import DetectorConfig
from services.detector.cylinder_kernels import assess
from services.detector.facing import facing
from services.detector.model import Floats
from services.detector.stacks import Stack
from services.detector.voxels import Voxels

_PRIOR_SLOPE = 0.02
"""Standard deviation of the lean left over after the stack's line was taken out, metres per metre."""
_PRIOR_TAPER = 0.008
"""Standard deviation of the taper about its mean, metres of radius per metre of height."""
MEAN_TAPER = -0.006
_CORRELATED = 12.0
"""Neighbouring points share fixed-pattern noise and bark: so many of them count as one in the covariance."""
_HELD = 1e12
"""Inverse variance of a view's offset where there is to be none."""
_BY_VIEW = np.zeros(3)
"""What tells the rays: each point's view, where it is known."""


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
    told_ray: Floats | None = None
    """(2,) in the plan, from the eye: where views are unknown and one side of the trunk tells."""


@dataclass(frozen=True, slots=True)
class _Fit:
    """What ``fit_axis`` gives: the last turn's points, rays and ranges in the axis frame, and the answer."""

    P: Floats
    U: Floats
    G: Floats
    x: Floats
    scale: float
    at: Floats
    slope: Floats
    normal: Floats


def _priors(radius: float, share: float = 1.0) -> Floats:
    """Return mean and inverse variance of (x, y, slope x, slope y, radius, taper) in the axis frame of a candidate.

    ``share`` of the usual deviation of the radius.
    """
    slope = 1.0 / (4 * _PRIOR_SLOPE) ** 2
    return np.array([
        [0.0, 1e-6], [0.0, 1e-6], [0.0, slope], [0.0, slope], [radius, 1.0 / (share * (0.12 * radius + 0.006)) ** 2],
        [MEAN_TAPER, 1.0 / _PRIOR_TAPER**2],
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
    if voxels.seen_from:
        found = _fitted(voxels, _BY_VIEW, stack, config, 1.0, _priors(stack.radius_m))
        if found is None:  # plants beside the trunk pulled it away: nearer to the slices, whose median they do not move
            found = _fitted(voxels, _BY_VIEW, stack, config, 1.0, _priors(stack.radius_m, 0.5), 0.5)
        return None if found is None else _measured(found, config)
    # without views the noise is not known beforehand
    found = _fitted(voxels, _BY_VIEW, stack, config, 3.0, _priors(stack.radius_m))
    if found is None:
        return None
    faced = _as_faced(voxels, stack, found, config)
    return faced if faced is not None else _measured(found, config)


def _fitted(
    voxels: Voxels, told: Floats, stack: Stack, config: DetectorConfig, start: float, prior: Floats, reach: float = 1.0
) -> _Fit | None:  # fmt: skip
    """Return the fit; ``told``: what tells the rays (``_ray_to``). Only known views have errors of their own."""
    held = 1.0 / config.view_noise_m**2 if voxels.seen_from and told is _BY_VIEW else _HELD
    at, slope = stack.at_m.copy(), stack.slope.copy()
    normal, x = np.zeros((6, 6)), np.zeros(6)
    scale, P, U, G = fit_axis(
        voxels.xyz_m, voxels.view, voxels.origins_m, told, at, slope, stack.radius_m, reach * _margin_m(stack, config),
        stack.z_low_m - 0.15, stack.z_high_m + 0.15, start, _CORRELATED, held, config.range_noise_per_m,
        config.surface_noise_m, prior, normal, x,
    )  # fmt: skip
    return None if scale < 0.0 else _Fit(P, U, G, x, float(scale), at, slope, normal)


def _as_faced(voxels: Voxels, stack: Stack, found: _Fit, config: DetectorConfig) -> Cylinder | None:
    """Return the fit along the ray that a one-sided trunk tells itself, twice: the first circle is too thin to tell it well."""
    radial_m = float(found.x[4])
    for _ in range(2):
        seen = facing(found.P, found.x)
        if seen is None:
            return None
        range_m = seen.range_m(config.range_noise_per_m, config.surface_noise_m)
        ray = np.array([1.0, *(range_m * seen.ray)])
        inferred = replace(stack, range_m=range_m, radius_m=max(float(found.x[4]), stack.radius_m))
        prior = _priors(inferred.radius_m)
        prior[4, 1] = 1.0 / (0.3 * inferred.radius_m + 0.01) ** 2  # the slices' radius is biased
        faced = _fitted(voxels, ray, inferred, config, 1.0, prior)
        if faced is None:
            return None
        found = faced
    seen = facing(found.P, found.x)
    if seen is None or not seen.plausible(float(found.x[4]), radial_m):
        return None
    measured = _measured(found, config)
    return None if measured is None else replace(measured, told_ray=seen.ray)


def fit_from(eye_m: Floats, voxels: Voxels, stack: Stack, config: DetectorConfig) -> Cylinder | None:
    """Return the joint fit of a candidate as seen from a place in the plan (2,), upright frame."""
    to = stack.at_m[:2] - eye_m
    range_m = float(np.hypot(to[0], to[1]))
    if range_m < 0.4:
        return None
    prior = _priors(stack.radius_m)
    prior[4, 1] = 1.0 / (0.3 * stack.radius_m + 0.01) ** 2  # the slices' radius is biased
    found = _fitted(voxels, np.array([2.0, *eye_m]), replace(stack, range_m=range_m), config, 1.0, prior)
    return None if found is None else _measured(found, config)


def _measured(fit: _Fit, config: DetectorConfig) -> Cylinder | None:
    P, U, G, x, at, slope = fit.P, fit.U, fit.G, fit.x, fit.at, fit.slope
    on, counts = np.zeros(len(P), dtype=np.int64), np.zeros(8)
    z_low = float(P[:, 2].min())
    bands = np.zeros(int((P[:, 2].max() - z_low) / 0.1) + 1, dtype=np.int64)
    assess(P, U, G, x, fit.scale, config.range_noise_per_m, config.surface_noise_m, on, counts, bands, z_low)
    held = np.flatnonzero(bands >= 3)
    if len(held) == 0:
        return None
    axis = np.array([slope[0], slope[1], 1.0]) / np.sqrt(1.0 + float(slope @ slope))
    low, high = z_low + 0.1 * held[0], min(z_low + 0.1 * (held[-1] + 1), float(P[:, 2].max()))
    covariance = np.asarray(np.linalg.inv(fit.normal), dtype=np.float64)
    return Cylinder(
        at_m=at, axis=axis, radius_m=float(x[4]), taper=float(x[5]), noise_m=float(counts[4]), scale=fit.scale,
        points=int(counts[0]), inside=int(counts[1]), around=int(counts[2]),
        fill=float(counts[6] / 0.36 / max(counts[7] / 0.8, 1.0)), arc_rad=min(float(counts[3]), 2.0 * np.pi),
        z_low_m=float(at[2] + low * axis[2]), z_high_m=float(at[2] + high * axis[2]),
        cover=len(held) / (held[-1] - held[0] + 1), range_m=float(counts[5]), covariance=covariance,
    )  # fmt: skip
