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
from services.detector.axis_fit import fit_axis, fit_views, to_upright
from services.fine.config import FineConfig
from services.fine.model import BREAST_HEIGHT_M, Floats, Section, Stem, StemPoints
from services.fine.stem_kernels import arc_of, fit_section, section_frame
from services.fine.taper import agreed, fit_taper, jackknife_sigma

_CORRELATED = 12.0
"""Neighbouring pixels share noise: so many count as one against the priors."""
_LEAST_POINTS = 200
_MARGIN_M = 0.08
"""Around the surface: what lies further is not the stem's."""
_CENTRE_SIGMA_M = 0.003
_AXIS_POINTS = 60_000
"""The joint fit takes so many, evenly: their neighbours say the same."""
_JOINT_TURNS, _FIT_TURNS = 3, 12
_VIEWS = 32
"""Parts of the recording that may lie a little beside each other in the joint fit."""
_HELD = 1.0 / 0.004**2
"""By so much (inverse variance): a frame's pose error, and the sensor's pattern that goes with the camera."""
_LEAST_ARC_RAD = 0.6
_GROUND_DOUBT_M = 0.02


@dataclass(frozen=True, slots=True)
class _Axis:
    """A line and the stem around it, map."""

    at: Floats
    slope: Floats
    radius_m: float
    """At ``at``."""
    taper: float
    """Change of radius per metre along the axis."""

    def at_height(self, z_m: float) -> Floats:
        """Return the point of the line (3,) at a height of the map."""
        return np.asarray(self.at + np.append(self.slope, 1.0) * (z_m - self.at[2]))


@dataclass(frozen=True, slots=True)
class _Sections:
    """Radii (B,) at heights above the foot, and (blocks, B) with each part of the recording left out."""

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
    group = _blocks(seen.frame, config.blocks)
    axis = _axis(tree, seen, origins_m, config)
    if axis is None:
        return None
    whole = _sections(axis, tree.z_m, seen, origins_m, config)
    if len(whole) < 3:
        return None
    left_out = []
    for k in range(config.blocks):
        kept = group != k
        part = StemPoints(seen.tree_id, seen.points_m[kept], seen.frame[kept])
        other = _axis(tree, part, origins_m, config, axis) if np.count_nonzero(kept) >= _LEAST_POINTS else None
        found = {} if other is None else _sections(other, tree.z_m, part, origins_m, config)
        # a height that shows without this part only as with it tells nothing of the doubt
        left_out.append([found[b].radius_m if b in found else whole[b].radius_m for b in whole])
    sections = _Sections(
        np.array([config.low_m + b * config.step_m for b in whole]), np.array([s.radius_m for s in whole.values()]),
        np.array(left_out), np.array([s.arc_rad for s in whole.values()]), np.array([s.points for s in whole.values()]),
    )  # fmt: skip
    return _stem(tree, axis, axis.at_height(tree.z_m), sections, seen, config)


def _axis(
    tree: Tree, seen: StemPoints, origins_m: Floats, config: FineConfig, begin: _Axis | None = None
) -> _Axis | None:
    """Return the joint fit of axis, radius and taper through all heights, begun at the live tree or at ``begin``.

    Lean and taper look much alike from one side: only the curvature of many points tells them apart, so all of them count.
    """
    every = max(1, len(seen.points_m) // _AXIS_POINTS)
    thinned = StemPoints(
        seen.tree_id, np.ascontiguousarray(seen.points_m[::every]), np.ascontiguousarray(seen.frame[::every])
    )
    axis = _first_axis(tree, thinned, origins_m, config) if begin is None else begin
    for _ in range(_JOINT_TURNS if axis is not None else 0):
        assert axis is not None
        axis = _improved(axis, tree, thinned, origins_m, config, every)
        if axis is None:
            break
    return axis


def _high_m(tree: Tree) -> float:
    """Return the height of the map up to which the joint fit takes points."""
    return tree.z_m + max(tree.height_seen_m, BREAST_HEIGHT_M + 0.3)


def _first_axis(tree: Tree, seen: StemPoints, origins_m: Floats, config: FineConfig) -> _Axis | None:
    """Return the live detector's fit to these points, begun at the live tree."""
    a = np.array(tree.axis)
    slope = a[:2] / max(a[2], 0.2)
    middle = np.array([tree.x_m, tree.y_m, tree.z_m]) + np.append(slope, 1.0) * BREAST_HEIGHT_M
    x, normal = np.zeros(6), np.zeros((6, 6))
    scale, *_ = fit_axis(
        seen.points_m, seen.frame, origins_m, np.zeros(3), middle, slope, tree.radius_m, _MARGIN_M, tree.z_m + config.flare_m,
        _high_m(tree), 1.5, _CORRELATED, _HELD, config.range_noise_per_m, config.surface_noise_m, _prior(tree.radius_m), normal, x,
    )  # fmt: skip
    return None if scale < 0.0 else _Axis(middle, slope, float(x[4]), float(x[5]))


def _prior(radius_m: float) -> Floats:
    """Return mean and inverse variance of place (2), slopes (2), radius and taper in the axis frame."""
    return np.array([
        [0.0, 1e-6], [0.0, 1e-6], [0.0, 150.0], [0.0, 150.0], [radius_m, 1.0 / 0.03**2], [-0.006, 1.0 / 0.008**2],
    ])  # fmt: skip


def _improved(
    axis: _Axis, tree: Tree, seen: StemPoints, origins_m: Floats, config: FineConfig, every: int
) -> _Axis | None:
    """Return the axis after one joint fit to all points near it; None where that fails or leaves the tree."""
    n = len(seen.points_m)
    P, U, G = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    section_frame(seen.points_m, seen.frame, origins_m, axis.at, axis.slope[0], axis.slope[1], P, U, G)
    z = seen.points_m[:, 2]
    near = _near_surface(P, G, axis.radius_m + axis.taper * P[:, 2], config)
    near &= (z > tree.z_m + config.flare_m) & (z < _high_m(tree))
    if np.count_nonzero(near) < _LEAST_POINTS:
        return None
    x, normal = np.array([0.0, 0.0, 0.0, 0.0, axis.radius_m, axis.taper]), np.zeros((6, 6))
    views = _blocks(seen.frame[near], _VIEWS).astype(np.int32)
    scale = fit_views(
        P[near], U[near], G[near], views, np.zeros((_VIEWS, 2)), int(views.max()) + 1, _HELD, every / _CORRELATED, x,
        config.range_noise_per_m, config.surface_noise_m, 1.5, _prior(axis.radius_m), normal, _FIT_TURNS,
    )  # fmt: skip
    if scale < 0.0 or abs(x[4] - tree.radius_m) > 0.35 * tree.radius_m + 0.02 or float(np.hypot(x[0], x[1])) > 0.1:
        return None
    R = np.empty((3, 3))
    to_upright(axis.slope[0], axis.slope[1], R)
    direction = R.T @ np.array([x[2], x[3], 1.0])
    return _Axis(axis.at + R.T @ np.array([x[0], x[1], 0.0]), direction[:2] / direction[2], float(x[4]), float(x[5]))


def _near_surface(P: Floats, G: Floats, radius_m: Floats, config: FineConfig) -> NDArray[np.bool_]:
    """Return which points may belong to the surface of a stem of radii (N,) around the z axis."""
    away = np.abs(np.hypot(P[:, 0], P[:, 1]) - radius_m)
    return np.asarray(away < _MARGIN_M + 0.5 * config.range_noise_per_m * G**2)


@dataclass(frozen=True, slots=True)
class _Circle:
    """One height's circle."""

    radius_m: float
    arc_rad: float
    points: int


def _sections(
    axis: _Axis, foot_m: float, seen: StemPoints, origins_m: Floats, config: FineConfig
) -> dict[int, _Circle]:
    """Fit a circle to each height's points; keys count steps of height from the lowest."""
    n = len(seen.points_m)
    P, U, G = np.empty((n, 3)), np.empty((n, 2)), np.empty(n)
    base = axis.at_height(foot_m)
    section_frame(seen.points_m, seen.frame, origins_m, base, axis.slope[0], axis.slope[1], P, U, G)
    upright = 1.0 / float(np.sqrt(1.0 + axis.slope @ axis.slope))
    above = (axis.at[2] - foot_m) / upright
    near = _near_surface(P, G, axis.radius_m + axis.taper * (P[:, 2] - above), config)
    band = np.floor((P[:, 2] * upright - config.low_m) / config.step_m + 0.5).astype(np.int64)
    found = {}
    for b in range(int(band[near].max(initial=-1)) + 1):
        chosen = np.flatnonzero(near & (band == b))
        length = (config.low_m + b * config.step_m) / upright
        start = max(axis.radius_m + axis.taper * (length - above), 0.01)
        circle = _circle(P[chosen], U[chosen], G[chosen], start, config)
        if circle is not None:
            found[b] = circle
    return found


def _circle(P: Floats, U: Floats, G: Floats, start_m: float, config: FineConfig) -> _Circle | None:
    """Return one height's circle; None where it does not show."""
    noise = (config.range_noise_per_m, config.surface_noise_m)
    x = np.array([0.0, 0.0, start_m])
    on = fit_section(P, U, G, *noise, _CENTRE_SIGMA_M, _CORRELATED, x)
    if on < _LEAST_POINTS // 4 or abs(x[2] - start_m) > 0.3 * start_m + 0.01:
        return None
    arc = float(arc_of(P, U, G, x, *noise))
    return _Circle(float(x[2]), arc, int(on)) if arc >= _LEAST_ARC_RAD else None


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
    live = tree.radius_m + float(line[1]) * (at_m - tree.radius_height_m)
    shift, sigma = agreed(radius, sigma, live, tree.sigma_radius_m)
    radius += shift
    upward = np.append(axis.slope, 1.0) / np.sqrt(1.0 + axis.slope @ axis.slope)
    return Stem(
        tree_id=tree.id, base_m=(float(base[0]), float(base[1]), float(base[2])),
        axis=(float(upward[0]), float(upward[1]), float(upward[2])), diameter_13_m=2.0 * radius, sigma_13_m=2.0 * sigma,
        height_m=at_m, taper_m_per_m=2.0 * float(line[1]), sigma_taper=2.0 * jackknife_sigma(lines[:, 1]),
        sections=_told(sections, used, shift, config), points=len(seen.points_m), frames=len(np.unique(seen.frame)),
        suitable=tree.suitable,
    )  # fmt: skip


def _told(sections: _Sections, used: NDArray[np.bool_], shift_m: float, config: FineConfig) -> tuple[Section, ...]:
    """Return the sections, all moved by ``shift_m`` of radius."""
    out = []
    for b, height in enumerate(sections.height_m):
        radius, arc = max(float(sections.radius_m[b]) + shift_m, 0.005), float(sections.arc_rad[b])
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
