"""When two trees are one, and what is believed of a tree that several flights have seen. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.inventory.config import InventoryConfig
from services.inventory.values import Belief, InventoryTree

Array = NDArray[np.float64]

_GATE_SIGMAS = 3.0
GATE_MAX_M = 0.75
"""However doubtful two positions are: trees stand farther apart."""
_COLUMN = 1 << 32
_SIGMA_FLOOR_M = 0.02
_RADIUS_FLOOR_M = 0.004
"""No flight knows a tree better than this: errors of its map are common to all its lists."""


@dataclass(frozen=True, slots=True)
class Spots:
    """Trees as arrays of one length: positions (N, 2), radii (N,), and their standard deviations, metres."""

    xy_m: Array
    radius_m: Array
    sigma_xy_m: Array
    sigma_radius_m: Array

    @staticmethod
    def of(rows: Sequence[tuple[float, float, float, float, float]]) -> Spots:
        """Return the arrays of rows (x, y, radius, sigma_xy, sigma_radius)."""
        table = np.array(rows, dtype=np.float64).reshape(-1, 5)
        return Spots(table[:, :2], table[:, 2], table[:, 3], table[:, 4])

    @staticmethod
    def of_trees(trees: Iterable[InventoryTree]) -> Spots:
        """Return trees of the inventory as arrays."""
        return Spots.of([(t.x_m, t.y_m, t.radius_m, t.sigma_xy_m, t.sigma_radius_m) for t in trees])

    def at(self, rows: NDArray[np.int64]) -> Spots:
        """Return some of the trees."""
        return Spots(self.xy_m[rows], self.radius_m[rows], self.sigma_xy_m[rows], self.sigma_radius_m[rows])

    def __len__(self) -> int:
        return len(self.radius_m)


def cells_of(x_m: Array, y_m: Array, side_m: float) -> NDArray[np.int64]:
    """Return the square cell that each place is in, as one number: one more for a step of y, ``_COLUMN`` for one of x."""
    return np.asarray(np.floor(x_m / side_m).astype(np.int64) * _COLUMN + np.floor(y_m / side_m).astype(np.int64))


def _neighbours(a: Spots, b: Spots) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pairs of two sets, as rows of ``a`` and of ``b``, that stand in the same or in touching cells."""
    cells = cells_of(b.xy_m[:, 0], b.xy_m[:, 1], GATE_MAX_M)
    order = np.argsort(cells, kind="stable")
    cells = cells[order]
    own = cells_of(a.xy_m[:, 0], a.xy_m[:, 1], GATE_MAX_M)
    rows, columns = [], []
    for at in (own - _COLUMN, own, own + _COLUMN):
        begin, end = np.searchsorted(cells, at - 1, side="left"), np.searchsorted(cells, at + 1, side="right")
        row = np.repeat(np.arange(len(a)), end - begin)
        first = np.cumsum(end - begin) - (end - begin)
        rows.append(row)
        columns.append(order[np.arange(len(row)) - first[row] + begin[row]])
    return np.concatenate(rows), np.concatenate(columns)


def _compatible(a: Spots, b: Spots, config: InventoryConfig) -> tuple[Array, NDArray[np.bool_]]:
    """Return the distances between trees of two sets, row by row, and which may be one tree."""
    distance = np.hypot(*(a.xy_m - b.xy_m).T)
    gate = np.minimum(np.maximum(config.merge_m, _GATE_SIGMAS * np.hypot(a.sigma_xy_m, b.sigma_xy_m)), GATE_MAX_M)
    radius_doubt = np.hypot(a.sigma_radius_m, b.sigma_radius_m)
    radius_gate = np.maximum(config.merge_radius_m, _GATE_SIGMAS * radius_doubt)
    return distance, (distance <= gate) & (np.abs(a.radius_m - b.radius_m) <= radius_gate)


def assign(new: Spots, known: Spots, config: InventoryConfig) -> NDArray[np.int64]:
    """Return for each new tree the known one that it is, or -1. No known tree is given twice: nearest pairs first."""
    found = np.full(len(new), -1, dtype=np.int64)
    if not len(new) or not len(known):
        return found
    rows, columns = _neighbours(new, known)  # not each with each: two long lists would take gigabytes
    distance, may = _compatible(new.at(rows), known.at(columns), config)
    rows, columns, distance = rows[may], columns[may], distance[may]
    taken: set[int] = set()
    # distance first, then the indices: equal distances give equal results on every machine
    for k in np.lexsort((columns, rows, distance)):
        row, column = int(rows[k]), int(columns[k])
        if found[row] < 0 and column not in taken:
            found[row] = column
            taken.add(column)
    return found


def partners(
    new: Spots, present: Sequence[bool], known: Sequence[InventoryTree], config: InventoryConfig
) -> list[InventoryTree | None]:
    """Return for each new tree the known one that it is, or None; none is given twice.

    Trees that are ``present`` in a list come before withdrawn ones, on both sides: else a ghost that was withdrawn
    beside a trunk would take the trunk's place.
    """
    found: list[InventoryTree | None] = [None] * len(new)
    taken: set[int] = set()
    spots = Spots.of_trees(known)
    for mine, theirs in ((True, True), (True, False), (False, True), (False, False)):
        rows = [i for i, here in enumerate(present) if here == mine and found[i] is None]
        columns = [k for k, t in enumerate(known) if (t.status == "present") == theirs and k not in taken]
        pairs = assign(new.at(np.array(rows, dtype=np.int64)), spots.at(np.array(columns, dtype=np.int64)), config)
        for row, k in zip(rows, pairs, strict=True):
            if k >= 0:
                found[row] = known[columns[int(k)]]
                taken.add(columns[int(k)])
    return found


def belief_of(t: Tree) -> Belief:
    """Return a tree of a list as a belief."""
    return Belief(t.x_m, t.y_m, t.z_m, t.radius_m, t.radius_height_m, t.height_seen_m, t.sigma_xy_m, t.sigma_radius_m,
                  t.confidence, t.observations, t.suitable)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Fused:
    """What several flights together say of a tree."""

    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    radius_height_m: float
    height_seen_m: float
    sigma_xy_m: float
    sigma_radius_m: float
    confidence: float
    observations: int
    suitable: bool


def fuse(placed: Iterable[tuple[Belief, tuple[float, float, float]]]) -> Fused:
    """Return the mean weighted by inverse variance: one belief per flight, for a flight's lists are no news to each other.

    ``placed``: each flight's newest belief with its position in the inventory's frame. Suitable is what the weight of
    the observations says; doubt goes against it.
    """
    beliefs = list(placed)
    weights = [1.0 / max(b.sigma_xy_m, _SIGMA_FLOOR_M) ** 2 for b, _ in beliefs]
    radius_weights = [1.0 / max(b.sigma_radius_m, _RADIUS_FLOOR_M) ** 2 for b, _ in beliefs]
    total, radius_total = sum(weights), sum(radius_weights)
    best = max(range(len(beliefs)), key=lambda i: weights[i])
    yes = sum(b.observations + 1 for b, _ in beliefs if b.suitable)
    no = sum(b.observations + 1 for b, _ in beliefs if not b.suitable)
    x, y, z = (sum(w * p[i] for w, (_, p) in zip(weights, beliefs, strict=True)) / total for i in range(3))
    return Fused(
        x_m=x, y_m=y, z_m=z,
        radius_m=sum(w * b.radius_m for w, (b, _) in zip(radius_weights, beliefs, strict=True)) / radius_total,
        radius_height_m=beliefs[best][0].radius_height_m, height_seen_m=max(b.height_seen_m for b, _ in beliefs),
        sigma_xy_m=math.sqrt(1.0 / total), sigma_radius_m=math.sqrt(1.0 / radius_total),
        confidence=1.0 - math.prod(1.0 - b.confidence for b, _ in beliefs),
        observations=sum(b.observations for b, _ in beliefs), suitable=yes > no,
    )  # fmt: skip
