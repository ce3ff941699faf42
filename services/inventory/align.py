"""Lay one flight's trees on the inventory by their pattern: a compass and a GPS are too coarse to tell trunks apart. Pure.

Pairs of trees vote: a pair of the flight and a pair of the inventory of the same length and with the same radii give
one turn and one shift. The turn and shift that most trees agree with wins, if no other that differs comes near it
(a plantation's rows repeat), and is refined by least squares (Umeyama 1991, without scale, in the plane).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.inventory.config import InventoryConfig
from services.inventory.merge import GATE_MAX_M, Array, Spots, assign, cells_of

_MOST_TREES = 40
_MIN_PAIR_M = 1.0
_MAX_PAIR_M = 25.0
_PAIR_SLACK = 0.02
"""Of a pair's length: by so much more than the prior's shift its middle may move."""
_CLEAR_SHARE = 0.75
"""Another placement that explains this share of the best one's trees makes it ambiguous."""
_SAME_TURN_RAD = math.radians(2.0)
_HYPOTHESES = 3_000
_SEPARATE_M = 0.6
_CELL_M = 0.1
_LEAST_SHARE = 0.4
"""Of the flight's trees that lie within the inventory's reach, at least so many must agree."""


@dataclass(frozen=True, slots=True)
class Prior:
    """How far the placement may be from the identity; None: nothing is known of it."""

    turn_rad: float
    shift_m: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """A turn about the origin, then a shift; and how many trees agree."""

    theta_rad: float
    shift_m: tuple[float, float]
    agreeing: int
    rms_m: float


def align(flight: Spots, known: Spots, config: InventoryConfig, prior: Prior | None) -> Alignment | None:
    """Return what takes the flight's trees onto the known ones, None when the pattern does not say so clearly.

    Without a prior twice as many trees must agree.
    """
    least = config.align_min_trees * (1 if prior is not None else 2)
    flight = _surest(flight, _MOST_TREES)
    known = _within_reach(flight, known, prior)
    if len(flight) < least or len(known) < least:
        return None
    turns, shifts = _hypotheses(flight, known, config, prior)
    if not len(turns):
        return None
    votes = _votes(flight, known, config, turns, shifts)
    best = int(np.argmax(votes))
    if votes[best] < least or _rival(flight, turns, shifts, votes, best) >= _CLEAR_SHARE * votes[best]:
        return None
    return _refined(flight, known, config, float(turns[best]), shifts[best], least)


def _surest(trees: Spots, most: int) -> Spots:
    return trees.at(np.argsort(trees.sigma_xy_m, kind="stable")[:most])


def _within_reach(flight: Spots, known: Spots, prior: Prior | None) -> Spots:
    """Return the known trees that the prior lets the flight's be: those beyond neither vote nor say how far it overlaps."""
    if prior is None or not len(flight):
        return known
    centre = flight.xy_m.mean(axis=0)
    extent = float(np.hypot(*(flight.xy_m - centre).T).max())
    reach = extent * (1.0 + prior.turn_rad) + prior.shift_m + _PAIR_SLACK * _MAX_PAIR_M + GATE_MAX_M
    return known.at(np.nonzero(np.hypot(*(known.xy_m - centre).T) <= reach)[0])


def _pairs(trees: Spots) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return ordered pairs (i, j) of different trees whose distance is useful, and the distances."""
    d = np.hypot(*(trees.xy_m[:, None] - trees.xy_m[None]).transpose(2, 0, 1))
    i, j = np.nonzero((d > _MIN_PAIR_M) & (d < _MAX_PAIR_M))
    return i, j, d[i, j]


def _hypotheses(flight: Spots, known: Spots, config: InventoryConfig, prior: Prior | None) -> tuple[Array, Array]:
    """Return turns (H,) and shifts (H, 2) of matching pairs, the longest baselines first."""
    known = _surest(known, 4 * _MOST_TREES)
    i, j, d = _pairs(flight)
    forward = i < j  # the other order gives the same hypotheses
    i, j, d = i[forward], j[forward], d[forward]
    k, m, e = _pairs(known)
    order = np.argsort(e, kind="stable")
    k, m, e = k[order], m[order], e[order]
    turns, shifts = [], []
    for a in np.argsort(-d, kind="stable"):
        low, high = np.searchsorted(e, (d[a] - config.merge_m, d[a] + config.merge_m))
        rows = np.arange(low, high)
        alike = np.abs(known.radius_m[k[rows]] - flight.radius_m[i[a]]) <= config.merge_radius_m
        alike &= np.abs(known.radius_m[m[rows]] - flight.radius_m[j[a]]) <= config.merge_radius_m
        rows = rows[alike]
        turn, shift = _from_pairs(flight, known, int(i[a]), int(j[a]), k[rows], m[rows])
        if prior is not None:
            centre = (flight.xy_m[i[a]] + flight.xy_m[j[a]]) / 2.0
            moved = _turned(centre[None], turn) + shift - centre
            fits = (np.abs(turn) <= prior.turn_rad) & (
                np.hypot(moved[:, 0], moved[:, 1]) <= prior.shift_m + _PAIR_SLACK * d[a]
            )
            turn, shift = turn[fits], shift[fits]
        turns.append(turn)
        shifts.append(shift)
        if sum(map(len, turns)) >= _HYPOTHESES:
            break
    if not turns:
        return np.zeros(0), np.zeros((0, 2))
    return np.concatenate(turns)[:_HYPOTHESES], np.concatenate(shifts)[:_HYPOTHESES]


def _from_pairs(
    flight: Spots, known: Spots, i: int, j: int, k: NDArray[np.int64], m: NDArray[np.int64]
) -> tuple[Array, Array]:
    """Return the turns and shifts that take the pair (i, j) onto the pairs (k, m), middle onto middle."""
    v = flight.xy_m[j] - flight.xy_m[i]
    w = known.xy_m[m] - known.xy_m[k]
    turn = _wrapped(np.arctan2(w[:, 1], w[:, 0]) - math.atan2(v[1], v[0]))
    middle = (flight.xy_m[i] + flight.xy_m[j]) / 2.0
    return turn, (known.xy_m[k] + known.xy_m[m]) / 2.0 - _turned(middle[None], turn)


def _turned(points: Array, turn: Array) -> Array:
    """Return points (1 or H, 2) turned by each of the angles (H,)."""
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]], axis=1)


def _wrapped(angle: Array) -> Array:
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)


def _moved(flight: Spots, turn: float, shift: Array) -> Spots:
    xy = _turned(flight.xy_m, np.full(len(flight), turn)) + shift
    return Spots(xy, flight.radius_m, flight.sigma_xy_m, flight.sigma_radius_m)


def _votes(flight: Spots, known: Spots, config: InventoryConfig, turns: Array, shifts: Array) -> NDArray[np.int64]:
    """Return for each placement how many of the flight's trees stand on a known one of like radius.

    The known trees are painted as discs into cells that hold their radii, so that a vote is one look-up.
    """
    cells, radius_m = _painted(known, min(config.merge_m, GATE_MAX_M))
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    x, y = flight.xy_m[:, 0][None], flight.xy_m[:, 1][None]
    wanted = cells_of(c * x - s * y + shifts[:, :1], s * x + c * y + shifts[:, 1:], _CELL_M)
    place = np.minimum(np.searchsorted(cells, wanted), len(cells) - 1)
    alike = np.abs(radius_m[place] - flight.radius_m[None]) <= config.merge_radius_m
    return np.asarray((alike & (cells[place] == wanted)).sum(axis=1), dtype=np.int64)


def _painted(known: Spots, disc_m: float) -> tuple[NDArray[np.int64], Array]:
    """Return the cells within ``disc_m`` of a known tree, in order, and the radius of the tree nearest to each.

    Only these are held: one tree far off would make a grid around all of them huge.
    """
    reach = int(disc_m / _CELL_M)
    steps = _CELL_M * np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    off = np.hypot(*steps.T)
    nearest_first = np.argsort(off, kind="stable")[: int(np.count_nonzero(off <= disc_m))]
    at = (known.xy_m[None] + steps[nearest_first, None]).reshape(-1, 2)
    cells, first = np.unique(cells_of(at[:, 0], at[:, 1], _CELL_M), return_index=True)
    return cells, known.radius_m[first % len(known)]


def _rival(flight: Spots, turns: Array, shifts: Array, votes: NDArray[np.int64], best: int) -> int:
    """Return the votes of the best placement that puts the trees elsewhere."""
    centre = flight.xy_m.mean(axis=0)[None]
    at = _turned(centre, turns) + shifts
    apart = np.hypot(*(at - at[best]).T) > _SEPARATE_M
    apart |= np.abs(_wrapped(turns - turns[best])) > _SAME_TURN_RAD * 3.0
    return int(votes[apart].max()) if apart.any() else 0


def _refined(
    flight: Spots, known: Spots, config: InventoryConfig, turn: float, shift: Array, least: int
) -> Alignment | None:
    """Return the least-squares placement over the agreeing trees, None when too few of those that should agree do."""
    for _ in range(3):
        moved = _moved(flight, turn, shift)
        partner = assign(moved, known, config)
        ours = np.nonzero(partner >= 0)[0]
        if len(ours) < least:
            return None
        p, q = flight.xy_m[ours], known.xy_m[partner[ours]]
        w = 1.0 / np.maximum(0.02, np.hypot(flight.sigma_xy_m[ours], known.sigma_xy_m[partner[ours]])) ** 2
        w /= w.sum()
        pc, qc = w @ p, w @ q
        a, b = p - pc, q - qc
        turn = math.atan2(float(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(w @ (a * b).sum(axis=1)))
        shift = qc - _turned(pc[None], np.array([turn]))[0]
    moved = _moved(flight, turn, shift)
    low, high = known.xy_m.min(axis=0) - 0.5, known.xy_m.max(axis=0) + 0.5
    inside = int(((moved.xy_m >= low) & (moved.xy_m <= high)).all(axis=1).sum())
    if len(ours) < _LEAST_SHARE * inside:
        return None
    errors = moved.xy_m[ours] - known.xy_m[partner[ours]]
    rms = float(np.sqrt((errors**2).sum(axis=1).mean()))
    return Alignment(turn, (float(shift[0]), float(shift[1])), len(ours), rms)
