"""Which object is which tree: by position and radius, for all trees in the window at once.

An error of the camera's pose moves all trees alike. So a common shift is looked for under which the objects explain
the trees best: two trees half a metre apart are told apart even when the pose is off by a third of that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.detector.refine.candidates import Fit
from services.detector.refine.model import ExpectedTree, Matrix, inverse_2x2

_MATCH_REWARD = 8.0
"""Half the squared Mahalanobis distance at which an object is no longer taken for a tree."""
_MIN_SHIFT_SIGMA_M = 0.03
_PLACE_FLOOR_M = 0.03
_RADIUS_FLOOR_M = 0.015


@dataclass(frozen=True, slots=True)
class Match:
    """The object taken for the target, and how much better this reading is than any with another object."""

    fit: Fit
    score: float
    margin: float


def associate(
    fits: list[Fit], trees: list[tuple[ExpectedTree, Matrix]], shift_covariance: Matrix, max_shift_m: float
) -> Match | None:
    """Return the object that is ``trees[0]``, or None when none is.

    All places are in the sight's frame (away, left).

    Args:
        fits: Objects, with their circles.
        trees: The target first, then the other trees that may be in the window; each with its place (2,).
        shift_covariance: (2, 2) of the common shift: what the pose's uncertainty does to the trees' places.
        max_shift_m: Larger shifts are not considered.
    """
    if not fits:
        return None
    information = inverse_2x2(shift_covariance + np.eye(2) * _MIN_SHIFT_SIGMA_M**2)
    shifts = [np.zeros(2)]
    for _, place in trees:
        shifts += [fit.parameters[:2] - place for fit in fits]
    best: dict[int, float] = {}
    for shift in shifts:
        if float(np.hypot(shift[0], shift[1])) > max_shift_m:
            continue
        score, target = _score(fits, trees, shift)
        score -= 0.5 * float(shift @ information @ shift)
        if target >= 0 and score > best.get(target, 0.0):
            best[target] = score
    if not best:
        return None
    ranked = sorted(best.items(), key=lambda item: (-item[1], item[0]))
    margin = ranked[0][1] - (ranked[1][1] if len(ranked) > 1 else 0.0)
    return Match(fits[ranked[0][0]], ranked[0][1], margin)


def _score(fits: list[Fit], trees: list[tuple[ExpectedTree, Matrix]], shift: Matrix) -> tuple[float, int]:
    """Return the reward of the best one-to-one matching under a shift, and the target's object (-1: none)."""
    pairs = []
    for t, (tree, place) in enumerate(trees):
        for k, fit in enumerate(fits):
            reward = _MATCH_REWARD - 0.5 * _distance2(fit, tree, place + shift)
            if reward > 0.0:
                pairs.append((-reward, t, k))
    total, target = 0.0, -1
    used_trees: set[int] = set()
    used_fits: set[int] = set()
    for negative, t, k in sorted(pairs):
        if t in used_trees or k in used_fits:
            continue
        used_trees.add(t)
        used_fits.add(k)
        total -= negative
        if t == 0:
            target = k
    return total, target


def _distance2(fit: Fit, tree: ExpectedTree, place: Matrix) -> float:
    """Return the squared Mahalanobis distance between an object and a tree: place across and away, and radius."""
    d = fit.parameters[:2] - place
    own = 0.25 * (fit.covariance[0, 0] + fit.covariance[1, 1])
    place_variance = tree.sigma_xy_m**2 + own + _PLACE_FLOOR_M**2
    radius_variance = tree.sigma_radius_m**2 + min(fit.covariance[2, 2], 0.01) + _RADIUS_FLOOR_M**2
    dr = fit.parameters[2] - tree.radius_m
    return float(d @ d) / place_variance + dr * dr / radius_variance
