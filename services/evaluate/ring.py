"""How well a map closes a trunk into one ring: thickness, doubled surface, disagreement of the keyframes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.simulation import TrueTree

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BREAST_M = (1.0, 1.6)
"""Heights above the foot: breast height with enough of the trunk to count."""
REACH_M = 0.15
"""Points further from the fitted surface belong to something else."""
MIN_POINTS = 100
_SECTORS = 36
_MIN_VIEW = 8
"""Points of one keyframe in one sector that make a median."""
_MIN_SECTOR = 30
_CLEAR_GAP = 4.0
"""Ashman's D of two halves: a cut Gaussian has 2.65, a cut uniform 3.46."""
_MIN_GAP_M = 0.02


@dataclass(frozen=True, slots=True)
class MapPoints:
    """Points (N, 3) of a map and the keyframe that saw each, (N,)."""

    points_m: Floats = field(repr=False)
    keyframe: Ints = field(repr=False)


@dataclass(frozen=True, slots=True)
class Ring:
    """One trunk at breast height."""

    points: int
    keyframes: int
    centre_m: tuple[float, float]
    """Fitted, in the plane across the trunk, from the true axis."""
    thickness_m: float
    """Half the width that holds the middle 68 % of the radial residuals."""
    doubled_share: float
    """Share of the points that lie on a second surface, apart from the first."""
    view_spread_m: float
    """RMS difference between what single keyframes say of the same 10 degrees of bark; NaN when none overlap."""


def ring_of(cloud: MapPoints, tree: TrueTree, search_m: float = 0.3) -> Ring | None:
    """Return the ring that the map makes of a tree, None when fewer than MIN_POINTS points show it.

    The axis' direction and the radius are the tree's (on one-sided arcs a free radius gives way to the noise along the
    rays); its place is fitted to the points, so that a map that is moved as a whole is not called thick.
    """
    plane, height = _cross_section(cloud.points_m, tree)
    near = (np.abs(height - sum(BREAST_M) / 2) < (BREAST_M[1] - BREAST_M[0]) / 2) & (
        np.hypot(plane[:, 0], plane[:, 1]) < tree.radius_m + search_m
    )
    plane, keyframe = plane[near], cloud.keyframe[near]
    if len(plane) < MIN_POINTS:
        return None
    x, y = fit_centre(plane, tree.radius_m, search_m)
    away = plane - (x, y)
    residual = np.hypot(away[:, 0], away[:, 1]) - tree.radius_m
    on = np.abs(residual) < REACH_M
    if np.count_nonzero(on) < MIN_POINTS:
        return None
    residual, keyframe, away = residual[on], keyframe[on], away[on]
    sector = np.floor((np.arctan2(away[:, 1], away[:, 0]) + np.pi) / (2 * np.pi) * _SECTORS).astype(np.int64)
    low, high = np.percentile(residual, [16, 84])
    return Ring(
        points=len(residual), keyframes=len(np.unique(keyframe)), centre_m=(x, y),
        thickness_m=float(high - low) / 2, doubled_share=doubled_share(residual, sector),
        view_spread_m=view_spread_m(residual, sector, keyframe),
    )  # fmt: skip


def _cross_section(points_m: Floats, tree: TrueTree) -> tuple[Floats, Floats]:
    """Return places (N, 2) in the plane across the trunk, its true axis at zero, and heights (N,) along it."""
    up = np.array(tree.axis, dtype=float)
    up /= np.linalg.norm(up)
    across = np.cross(up, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    local = points_m - np.array([tree.x_m, tree.y_m, tree.z_m])
    return np.stack([local @ across, local @ np.cross(up, across)], axis=1), local @ up


def fit_centre(plane: Floats, radius_m: float, reach_m: float) -> tuple[float, float]:
    """Return the centre of the circle of known radius nearest to points (N, 2), looked for around zero.

    Geometric residuals, Tukey weights whose reach shrinks to 5 cm, Gauss-Newton.
    """
    x, y = _coarse_centre(plane, radius_m, reach_m)
    for limit in (0.15, 0.10, 0.07, *([0.05] * 8)):
        dx, dy = plane[:, 0] - x, plane[:, 1] - y
        d = np.maximum(np.hypot(dx, dy), 1e-6)
        e = d - radius_m
        w = np.where(np.abs(e) < limit, (1.0 - (e / limit) ** 2) ** 2, 0.0)
        if w.sum() < 20.0:
            break
        J = np.stack([-dx / d, -dy / d], axis=1)
        step = np.linalg.solve(J.T @ (J * w[:, None]) + 1e-6 * np.eye(2), -J.T @ (w * e))
        x, y = float(x + step[0]), float(y + step[1])
    return x, y


def _coarse_centre(plane: Floats, radius_m: float, reach_m: float) -> tuple[float, float]:
    """Return the centre, of a grid about zero, with the most points near the known radius."""
    best, at = -1.0, (0.0, 0.0)
    thinned = plane[:: max(1, len(plane) // 1500)]
    steps = np.arange(-reach_m, reach_m + 1e-9, 0.02)
    for x in steps:
        for y in steps:
            e = np.hypot(thinned[:, 0] - x, thinned[:, 1] - y) - radius_m
            votes = float(np.exp(-0.5 * (e / 0.02) ** 2).sum()) * (1.0 - 0.1 * np.hypot(x, y) / reach_m)
            if votes > best:
                best, at = votes, (float(x), float(y))
    return at


def doubled_share(residual_m: Floats, sector: Ints) -> float:
    """Return the share of points on a second surface: sectors whose residuals fall into two clearly parted groups.

    Each sector is cut where the two sides vary least; parted means Ashman's D above 4 (Ashman, Bird and Zepf, 1994,
    equation 4) and means 2 cm apart.
    """
    second, total = 0, 0
    for s in np.unique(sector):
        values = np.sort(residual_m[sector == s])
        n = len(values)
        if n < _MIN_SECTOR:
            continue
        total += n
        cut = _best_cut(values)
        low, high = values[:cut], values[cut:]
        gap = float(high.mean() - low.mean())
        if gap > _MIN_GAP_M and gap > _CLEAR_GAP * np.sqrt((low.var() + high.var()) / 2):
            second += min(len(low), len(high))
    return second / total if total else 0.0


def _best_cut(values: Floats) -> int:
    """Return where sorted values are cut so that the variance within both sides is least; 5 % stay on each side."""
    n = len(values)
    edge = max(2, n // 20)
    at = np.arange(edge, n - edge)
    total, head = values.sum(), np.cumsum(values)[at - 1]
    between = head**2 / at + (total - head) ** 2 / (n - at)
    return int(at[np.argmax(between)])


def view_spread_m(residual_m: Floats, sector: Ints, keyframe: Ints) -> float:
    """Return the RMS of single keyframes' median residuals about their sector's mean of medians."""
    deviations: list[float] = []
    for s in np.unique(sector):
        here = sector == s
        medians = [
            float(np.median(residual_m[here & (keyframe == k)]))
            for k in np.unique(keyframe[here])
            if np.count_nonzero(here & (keyframe == k)) >= _MIN_VIEW
        ]
        if len(medians) >= 2:
            deviations += list(np.array(medians) - np.mean(medians))
    return float(np.sqrt(np.mean(np.square(deviations)))) if deviations else float("nan")
