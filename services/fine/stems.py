"""Measures a stem from the points of all frames: one axis, a section every 10 cm, and a taper function through them.

Residuals run along the viewing ray, as depth noise does (services/detector/ray.py). How sure a diameter is comes from
leaving out parts of the recording in turn (Efron and Tibshirani, "An introduction to the bootstrap" (1993), chapter 11),
which sees what neighbouring pixels and frames share, and from the side that does not show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.detector.cylinder_kernels import fit_axis
from services.fine.config import FineConfig
from services.fine.model import BREAST_HEIGHT_M, Floats, Section, Stem, StemPoints
from services.fine.stem_kernels import arc_of, fit_section, section_frame

_CORRELATED = 12.0
"""Neighbouring pixels share noise: so many count as one against the priors."""
_LEAST_POINTS = 200
_MARGIN_M = 0.08
"""Around the surface: what lies further is not the stem's."""
_CENTRE_SIGMA_M = 0.003
_TUKEY = 4.0
_GROUND_DOUBT_M = 0.02


@dataclass(frozen=True, slots=True)
class _Axis:
    """A line and the stem around it, map."""

    at: Floats
    slope: Floats
    radius_m: float
    taper: float


@dataclass(frozen=True, slots=True)
class _Sections:
    """Radii (B,) at heights along the axis, and (blocks, B) with each part of the recording left out."""

    height_m: Floats
    radius_m: Floats
    left_out_m: Floats
    arc_rad: Floats
    points: NDArray[np.int64]


def measure_stem(tree: Tree, seen: StemPoints, origins_m: Floats, config: FineConfig) -> Stem | None:
    """Return the stem of a tree of the live list, or None where too little of it was seen.

    Args:
        tree: where it stands and about how thick it is.
        seen: points near it.
        origins_m: (F, 3) camera centres by frame, map.
        config: the numbers.
    """
    if len(seen.points_m) < _LEAST_POINTS:
        return None
    axis = _axis(tree, seen, origins_m, config)
    if axis is None:
        return None
    base = axis.at + np.append(axis.slope, 1.0) * (tree.z_m - axis.at[2])
    sections = _sections(axis, base, seen, origins_m, config)
    if len(sections.height_m) < 3:
        return None
    return _stem(tree, axis, base, sections, seen, config)


def _axis(tree: Tree, seen: StemPoints, origins_m: Floats, config: FineConfig) -> _Axis | None:
    """Return the joint fit of axis, radius and taper through all heights, begun at the live tree."""
    a = np.array(tree.axis)
    slope = a[:2] / max(a[2], 0.2)
    middle = np.array([tree.x_m, tree.y_m, tree.z_m]) + np.append(slope, 1.0) * BREAST_HEIGHT_M
    high = tree.z_m + max(tree.height_seen_m, BREAST_HEIGHT_M + 0.3)
    every = max(1, len(seen.points_m) // 60_000)
    xyz = seen.points_m[::every].astype(np.float64)
    ray = xyz - origins_m[seen.frame[::every]]
    x, normal = np.zeros(6), np.zeros((6, 6))
    prior = np.array(
        [[0.0, 1e-6], [0.0, 1e-6], [0.0, 150.0], [0.0, 150.0], [tree.radius_m, 1.0 / 0.03**2], [-0.006, 1.0 / 0.008**2]]
    )
    scale, *_ = fit_axis(
        xyz, ray, middle, slope, tree.radius_m, _MARGIN_M, tree.z_m + config.flare_m, high, 1.5, _CORRELATED,
        config.range_noise_per_m, config.surface_noise_m, prior, normal, x,
    )  # fmt: skip
    return None if scale < 0.0 else _Axis(middle, slope, float(x[4]), float(x[5]))


def _sections(axis: _Axis, base: Floats, seen: StemPoints, origins_m: Floats, config: FineConfig) -> _Sections:
    """Fit a circle to each height's points, whole and with each part of the recording left out."""
    n = len(seen.points_m)
    P, U, G = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    section_frame(seen.points_m, seen.frame, origins_m, base, axis.slope[0], axis.slope[1], P, U, G)
    upright = 1.0 / float(np.sqrt(1.0 + axis.slope @ axis.slope))
    height = P[:, 2] * upright
    expected = axis.radius_m + axis.taper * (P[:, 2] - (axis.at[2] - base[2]) / upright)
    near = np.abs(np.hypot(P[:, 0], P[:, 1]) - expected) < _MARGIN_M + 0.5 * config.range_noise_per_m * G**2
    group = _blocks(seen.frame, config.blocks)
    band = np.floor((height - config.low_m) / config.step_m + 0.5).astype(np.int64)
    found = []
    for b in range(int(band.max(initial=-1)) + 1):
        chosen = np.flatnonzero(near & (band == b))
        middle = config.low_m + b * config.step_m
        start = max(axis.radius_m + axis.taper * (middle / upright - (axis.at[2] - base[2]) / upright), 0.01)
        section = _section(P[chosen], U[chosen], G[chosen], group[chosen], start, config)
        if section is not None:
            found.append((middle, *section))
    columns = list(zip(*found, strict=True)) if found else [(), (), (), (), ()]
    return _Sections(
        np.array(columns[0], dtype=float), np.array(columns[1], dtype=float),
        np.array(columns[2], dtype=float).reshape(len(found), config.blocks).T, np.array(columns[3], dtype=float),
        np.array(columns[4], dtype=np.int64),
    )  # fmt: skip


def _section(
    P: Floats, U: Floats, G: Floats, group: NDArray[np.int64], start_m: float, config: FineConfig
) -> tuple[float, Floats, float, int] | None:
    """Return radius, radii with each part left out, arc and points of one height; None where it does not show."""
    noise = (config.range_noise_per_m, config.surface_noise_m)
    x = np.array([0.0, 0.0, start_m])
    on = fit_section(P, U, G, group, -1, *noise, _CENTRE_SIGMA_M, _CORRELATED, x)
    if on < _LEAST_POINTS // 4 or abs(x[2] - start_m) > 0.3 * start_m + 0.01:
        return None
    arc = float(arc_of(P, U, G, x, *noise))
    if arc < 0.6:
        return None
    radii = np.empty(config.blocks)
    for k in range(config.blocks):
        y = np.array([0.0, 0.0, x[2]])
        radii[k] = y[2] if fit_section(P, U, G, group, k, *noise, _CENTRE_SIGMA_M, _CORRELATED, y) else x[2]
    return float(x[2]), radii, arc, int(on)


def _blocks(frame: NDArray[np.int32], blocks: int) -> NDArray[np.int64]:
    """Return to which part of the recording each point belongs: parts of as many frames as saw the stem."""
    frames, index = np.unique(frame, return_inverse=True)
    return np.asarray(index * blocks // max(len(frames), 1), dtype=np.int64)


def _stem(
    tree: Tree, axis: _Axis, base: Floats, sections: _Sections, seen: StemPoints, config: FineConfig
) -> Stem:  # fmt: skip
    """Put the taper function through the sections, whole and with each part left out."""
    weight = _weights(sections, config)
    line, used = fit_taper(sections.height_m, sections.radius_m, weight)
    lines = np.array([fit_taper(sections.height_m, radii, weight * used)[0] for radii in sections.left_out_m])
    low, high = sections.height_m[used].min(), sections.height_m[used].max()
    at_m = float(np.clip(BREAST_HEIGHT_M, low, high))
    radius = float(line[0] + line[1] * (at_m - BREAST_HEIGHT_M))
    spread = jackknife_sigma(lines[:, 0] + lines[:, 1] * (at_m - BREAST_HEIGHT_M))
    shown = float(np.median(sections.arc_rad[used]))
    unseen = config.out_of_round * radius * min(1.0, np.pi / shown) * max(0.0, 1.0 - shown / (2.0 * np.pi)) * 2.0
    sigma = float(np.hypot(np.hypot(spread, unseen), line[1] * _GROUND_DOUBT_M))
    upward = np.append(axis.slope, 1.0) / np.sqrt(1.0 + axis.slope @ axis.slope)
    return Stem(
        tree_id=tree.id, base_m=(float(base[0]), float(base[1]), float(base[2])),
        axis=(float(upward[0]), float(upward[1]), float(upward[2])), diameter_13_m=2.0 * radius, sigma_13_m=2.0 * sigma,
        height_m=at_m, taper_m_per_m=2.0 * float(line[1]), sigma_taper=2.0 * jackknife_sigma(lines[:, 1]),
        sections=_told(sections, used, config), points=len(seen.points_m), frames=len(np.unique(seen.frame)),
        suitable=tree.suitable,
    )  # fmt: skip


def _told(sections: _Sections, used: NDArray[np.bool_], config: FineConfig) -> tuple[Section, ...]:
    out = []
    for b, height in enumerate(sections.height_m):
        radius, arc = float(sections.radius_m[b]), float(sections.arc_rad[b])
        unseen = config.out_of_round * radius * max(0.0, 1.0 - arc / (2.0 * np.pi)) * 2.0
        sigma = float(np.hypot(jackknife_sigma(sections.left_out_m[:, b]), unseen))
        out.append(Section(float(height), 2.0 * radius, 2.0 * sigma, arc, int(sections.points[b]), bool(used[b])))
    return tuple(out)


def _weights(sections: _Sections, config: FineConfig) -> Floats:
    """Return each section's weight in the taper function: by its spread, with a floor that bark gives all; none in the flare."""
    spread = np.array([jackknife_sigma(column) for column in sections.left_out_m.T])
    weight = 1.0 / (spread**2 + (0.01 * sections.radius_m + 0.0005) ** 2)
    above = sections.height_m >= config.flare_m
    return np.asarray(np.where(above, weight, 0.0) if np.count_nonzero(above) >= 3 else weight)


def jackknife_sigma(values: Floats) -> float:
    """Return the standard deviation of an estimate from its values with each of n groups left out."""
    n = len(values)
    return float(np.sqrt((n - 1) / n * np.sum((values - values.mean()) ** 2)))


def fit_taper(height_m: Floats, radius_m: Floats, weight: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Return (radius at 1.3 m, its change per metre) of a line through sections, and which of them it took for good.

    Iteratively reweighted (Tukey's biweight): a branch whorl or a hidden height does not pull it. The change has a weak
    prior about -6 mm a metre, so that a short piece of stem does not extrapolate wildly.
    """
    x = height_m - BREAST_HEIGHT_M
    held = weight > 0.0
    robust = weight.copy()
    line = np.array([float(np.median(radius_m[held])), -0.006])
    for _ in range(15):
        A = np.array([[robust.sum(), (robust * x).sum()], [(robust * x).sum(), (robust * x * x).sum() + 1.0 / 0.02**2]])
        y = np.array([(robust * radius_m).sum(), (robust * x * radius_m).sum() - 0.006 / 0.02**2])
        line = np.linalg.solve(A, y)
        off = (radius_m - line[0] - line[1] * x) * np.sqrt(weight)
        spread = max(1.0, 1.4826 * float(np.median(np.abs(off[held]))))
        t = off / (_TUKEY * spread)
        robust = np.where(np.abs(t) < 1.0, weight * (1.0 - t * t) ** 2, 0.0)
        if not np.count_nonzero(robust):
            robust = weight.copy()
    return line, robust > 0.0
