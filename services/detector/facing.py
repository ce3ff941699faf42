"""Clouds that do not tell from where they were seen: a trunk of which one side shows tells it itself.

A camera, or a scanner on one stand, sees the side that faces it. The mean direction of the surface points from the axis is
then the direction to the eye, and the scatter along it the sensor's noise. With that ray the fit is the unbiased one of
``ray``; a radial fit of a noisy one-sided arc comes out 1 to 2 cm thin and drags the axis towards the eye.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.detector.model import Floats

_ONE_SIDED = 0.5
"""Length of the mean outward unit vector: 0 for a whole ring, 0.79 for the half that one eye sees."""
_WIDEST_RAD = 4.2
"""A trunk that shows more than 240 degrees was seen from several sides, however unevenly."""
_MOST_BEHIND = 0.25
_LEAST_BIAS_M = 0.004
"""Noise thins a radial fit by about its square over the radius; where that is less, the radial fit assumes less."""
LONGEST_M = 6.5


@dataclass(frozen=True, slots=True)
class Facing:
    """From where a trunk was seen, in the frame of its axis."""

    ray: Floats
    """(2,) unit vector from the eye to the trunk, in the plan."""
    noise_m: float
    """Scatter of the surface along the ray."""
    behind: float
    """Share of the points that lie beyond the axis."""

    def range_m(self, k_range: float, surface_m: float) -> float:
        """Return the range at which a depth camera has this noise."""
        depth2 = max(self.noise_m**2 - surface_m**2, 0.0)
        return float(np.clip(np.sqrt(np.sqrt(depth2) / max(k_range, 1e-9)), 0.3, LONGEST_M))

    def plausible(self, radius_m: float, radial_m: float) -> bool:
        """Tell whether this can be a trunk's face, given its radius and that of the radial fit.

        Thin bushes scatter through, with points before and behind the axis; and noise thins a radial fit by about its
        square over the radius, not by more.
        """
        clean = self.behind < _MOST_BEHIND and self.noise_m < min(0.055, 0.5 * radius_m + 0.02)
        return clean and abs(radius_m - radial_m) < 3.0 * self.noise_m**2 / radius_m + 0.005


def facing(P: Floats, x: Floats) -> Facing | None:
    """Return how a fitted trunk was seen; None when it shows all around.

    ``P`` (N, 3): points in the frame of the axis; ``x``: the fit (centre, slopes, radius, taper).
    """
    z = P[:, 2]
    d = P[:, :2] - x[:2] - z[:, None] * x[2:4]
    r = np.maximum(x[4] + x[5] * z, 0.005)
    length = np.maximum(np.hypot(d[:, 0], d[:, 1]), 1e-6)
    near = length < 1.6 * r + 0.05
    if np.count_nonzero(near) < 15:
        return None
    d, r, length = d[near], r[near], length[near]
    mean = (d / length[:, None]).mean(axis=0)
    strength = float(np.hypot(mean[0], mean[1]))
    if strength < _ONE_SIDED:
        return None
    if _arc_rad(d) > _WIDEST_RAD:
        return None
    ray = -mean / strength
    along, aside = d @ ray, d[:, 0] * ray[1] - d[:, 1] * ray[0]
    middle = np.abs(aside) < 0.8 * r
    if np.count_nonzero(middle) < 10:
        return None
    e = along[middle] + np.sqrt(r[middle] ** 2 - aside[middle] ** 2)
    noise = 1.4826 * float(np.median(np.abs(e - np.median(e))))
    return (
        Facing(ray, noise, float(np.mean(along > 0.0))) if noise**2 / max(float(x[4]), 0.01) > _LEAST_BIAS_M else None
    )


def _arc_rad(d: Floats) -> float:
    """Return the arc over which points lie, in sectors of 10 degrees that hold a fair share of the fullest."""
    sector = ((np.arctan2(d[:, 1], d[:, 0]) + np.pi) / (2.0 * np.pi) * 36.0).astype(np.int64) % 36
    counts = np.bincount(sector, minlength=36)
    return float(np.count_nonzero(counts > 0.12 * np.percentile(counts, 90.0)) * 2.0 * np.pi / 36.0)


_AGREE_COSINE = 0.966
"""Faces within 15 degrees of looking at a place look at it."""


def common_eye(places_m: Floats, rays: Floats, ranges_m: Floats) -> Floats | None:
    """Return the place in the plan (2,) that most trunks' faces look at; None when they do not look at one place.

    ``places_m`` (K, 2) axes, ``rays`` (K, 2) unit vectors from the eye, ``ranges_m`` (K,) by the noise. A camera that turned
    on the spot gives one; a walk along a row gives none.
    """
    if len(places_m) == 0:
        return None
    guesses = [places_m - rays * ranges_m[:, None]]
    for i in range(min(len(places_m), 12)):
        for j in range(i):
            meeting = _meeting(places_m[[i, j]], rays[[i, j]])
            if meeting is not None:
                guesses.append(meeting[None])
    best: Floats | None = None
    seen: NDArray[np.bool_] = np.zeros(len(places_m), dtype=np.bool_)
    for guess in np.concatenate(guesses):
        agree = _looks_from(guess, places_m, rays)
        if np.count_nonzero(agree) > np.count_nonzero(seen):
            best, seen = guess, agree
    if best is None or np.count_nonzero(seen) < 0.6 * len(places_m):
        return None
    refined = _meeting(places_m[seen], rays[seen])
    keeps = refined is not None and np.count_nonzero(_looks_from(refined, places_m, rays)) >= np.count_nonzero(seen)
    return refined if keeps else best


def _looks_from(eye: Floats, places_m: Floats, rays: Floats) -> NDArray[np.bool_]:
    to = places_m - eye
    distance = np.hypot(to[:, 0], to[:, 1])
    return np.asarray(((to * rays).sum(axis=1) > _AGREE_COSINE * distance) & (distance > 0.4))


def _meeting(places_m: Floats, rays: Floats) -> Floats | None:
    """Return the point nearest to the lines through places along rays (least squares); None when they are parallel."""
    across = np.eye(2) - rays[:, :, None] * rays[:, None, :]
    A, y = across.sum(axis=0), (across @ places_m[:, :, None]).sum(axis=0)[:, 0]
    if np.linalg.eigvalsh(A)[0] < 0.05 * len(rays):
        return None
    return np.asarray(np.linalg.solve(A, y))
