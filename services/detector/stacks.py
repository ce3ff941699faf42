"""Circles of neighbouring slices become lean lines: one line per trunk candidate."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median

import numpy as np
from numba import njit

from services.detector.arcs import Circles
from services.detector.config import DetectorConfig
from services.detector.model import Floats, Ints


@dataclass(frozen=True, slots=True)
class Stack:
    """A candidate trunk: a line through circles of several layers, in the upright frame."""

    at_m: Floats
    """(3,): a point of the axis."""
    slope: Floats
    """(2,): dx/dz, dy/dz."""
    radius_m: float
    range_m: float
    """Typical distance it was seen from, 0 where views are unknown."""
    z_low_m: float
    z_high_m: float
    layers: int
    cover: float
    """Share of the layers between lowest and highest that show the circle."""


def _tolerance(noise_m: Floats, on: Ints, radius_m: Floats) -> Floats:
    """Return how far each slice's centre may be off: a floor, and its noise, which few points average badly."""
    return np.asarray(0.015 + 0.10 * radius_m + 1.5 * noise_m / np.sqrt(np.maximum(1.0, on / 6.0)))


@njit(cache=True, nogil=True)
def _root(parent: Ints, a: int) -> int:
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(cache=True, nogil=True)
def _may_follow(xyz: Floats, radius: Floats, tol: Floats, i: int, j: int, max_slope: float) -> bool:
    """Tell whether circle ``j``, some layers above ``i``, could belong to the same trunk."""
    both = tol[i] + tol[j]
    reach = both + max_slope * (xyz[j, 2] - xyz[i, 2])
    dx, dy = xyz[j, 0] - xyz[i, 0], xyz[j, 1] - xyz[i, 1]
    if abs(dx) > reach or dx * dx + dy * dy > reach * reach:
        return False
    return abs(radius[i] - radius[j]) <= both + 0.2 * min(radius[i], radius[j])


@njit(cache=True, nogil=True)
def _link(layer: Ints, xyz: Floats, radius: Floats, tol: Floats, max_slope: float, group: Ints) -> None:
    """Group circles that could follow each other within three layers: ``group`` gets one of the group's members."""
    n = layer.shape[0]
    order = np.argsort(layer, kind="mergesort")
    parent = np.arange(n)
    for q in range(n):
        i = order[q]
        for p in range(q + 1, n):
            j = order[p]
            gap = layer[j] - layer[i]
            if gap > 3:
                break
            if gap > 0 and _may_follow(xyz, radius, tol, i, j, max_slope):
                a, b = _root(parent, i), _root(parent, j)
                parent[max(a, b)] = min(a, b)
    for i in range(n):
        group[i] = _root(parent, i)


@njit(cache=True, nogil=True)
def _support(
    members: Ints, n: int, layer: Ints, xyz: Floats, radius: Floats, tol: Floats, i: int, sx: float, sy: float, r: float,
    chosen: Ints,
) -> float:  # fmt: skip
    """Return the number of layers, weighted by fit, that one line holds; mark the best circle of each layer."""
    total, q = 0.0, 0
    while q < n:  # members come sorted by layer
        best, at = 0.0, -1
        level = layer[members[q]]
        while q < n and layer[members[q]] == level:
            m = members[q]
            dz = xyz[m, 2] - xyz[i, 2]
            dx = xyz[m, 0] - xyz[i, 0] - sx * dz
            dy = xyz[m, 1] - xyz[i, 1] - sy * dz
            e = (dx * dx + dy * dy) / (tol[m] * tol[m])
            er = abs(radius[m] - r) / (tol[m] + 0.15 * r)
            fit = (1.0 - e) * (1.0 - er * er) if e < 1.0 and er < 1.0 else 0.0
            chosen[q] = 0
            if fit > best:
                best, at = fit, q
            q += 1
        if at >= 0:
            chosen[at] = 1
            total += 0.5 + 0.5 * best
    return total


@njit(cache=True, nogil=True)
def _best_line(
    members: Ints, n: int, layer: Ints, xyz: Floats, radius: Floats, tol: Floats, max_slope: float, chosen: Ints
) -> float:
    """Return the support of the best line through two circles of a group; ``chosen`` marks its circles."""
    trial = np.empty(n, dtype=np.int64)
    top = 0.0
    step = max(1, (n * n) // 4000)
    pair = 0
    for p in range(n):
        for q in range(p + 1, n):
            i, j = members[p], members[q]
            if layer[j] - layer[i] < 2:
                continue
            pair += 1
            if pair % step != 0:
                continue
            dz = xyz[j, 2] - xyz[i, 2]
            sx, sy = (xyz[j, 0] - xyz[i, 0]) / dz, (xyz[j, 1] - xyz[i, 1]) / dz
            if sx * sx + sy * sy > max_slope * max_slope:
                continue
            r = 0.5 * (radius[i] + radius[j])
            support = _support(members, n, layer, xyz, radius, tol, i, sx, sy, r, trial)
            if support > top:
                top = support
                chosen[:n] = trial[:n]
    return top


@njit(cache=True, nogil=True)
def _all_lines(
    layer: Ints,
    xyz: Floats,
    radius: Floats,
    tol: Floats,
    group: Ints,
    max_slope: float,
    min_support: float,
    line_of: Ints,
) -> int:
    """Give each circle the number of its line, or -1; return the number of lines."""
    n = layer.shape[0]
    line_of[:] = -1
    order = np.argsort(group * np.int64(100000) + layer, kind="mergesort")
    lines, q = 0, 0
    while q < n:
        end = q
        while end < n and group[order[end]] == group[order[q]]:
            end += 1
        members = order[q:end].copy()
        left = end - q
        chosen = np.zeros(left, dtype=np.int64)
        for _ in range(6):
            if left < min_support:
                break
            support = _best_line(members, left, layer, xyz, radius, tol, max_slope, chosen)
            if support < min_support:
                break
            kept = 0
            for m in range(left):
                if chosen[m] == 1:
                    line_of[members[m]] = lines
                else:
                    members[kept] = members[m]
                    kept += 1
            left = kept
            lines += 1
        q = end
    return lines


def _as_stack(circles: Circles, tol_all: Floats, members: Ints) -> Stack:
    """Return the weighted least-squares line through the circles of one candidate."""
    xyz, radius, tol = circles.xyz_m[members], circles.radius_m[members], tol_all[members]
    weight = 1.0 / tol**2
    at = (weight[:, None] * xyz).sum(axis=0) / weight.sum()
    d = xyz - at
    spread = float((weight * d[:, 2] ** 2).sum())
    slope = (weight[:, None] * d[:, 2:] * d[:, :2]).sum(axis=0) / max(spread, 1e-9)
    layers = circles.layer[members]
    extent = int(layers.max() - layers.min()) + 1
    return Stack(
        at, slope, median(radius.tolist()), median(circles.range_m[members].tolist()), float(xyz[:, 2].min()), float(xyz[:, 2].max()), len(members),
        len(members) / extent,
    )  # fmt: skip


def stack_circles(circles: Circles, min_support: float, config: DetectorConfig) -> list[Stack]:
    """Return the lean lines of at least ``min_support`` layers, the best supported first."""
    n = len(circles.layer)
    if n == 0:
        return []
    c = circles
    tol = _tolerance(c.noise_m, c.on, c.radius_m)
    group, line_of = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    max_slope = float(np.tan(config.max_lean_rad))
    _link(c.layer, c.xyz_m, c.radius_m, tol, max_slope, group)
    lines = int(_all_lines(c.layer, c.xyz_m, c.radius_m, tol, group, max_slope, min_support, line_of))
    stacks = [_as_stack(circles, tol, np.flatnonzero(line_of == k)) for k in range(lines)]
    return sorted(stacks, key=lambda s: (-s.layers, s.at_m[0], s.at_m[1]))
