"""Distance of a point from a circle along the viewing ray, and its noise.

Depth noise lies along the ray. A radial residual turns it into a bias: points before and behind the surface both
pull the circle thinner on a one-sided arc. The residual along the ray is the noise itself. With the unit ray ``u``
(in the plan), the centre ``c`` and the point ``p``: ``a = (c - p) . u``, ``s = (c - p) x u``; the ray enters the
circle at ``a - sqrt(r^2 - s^2)`` beyond the point. Rays that pass near or beside the rim are continued linearly.
Without views the residual is radial, ``|p - c| - r`` (Chernov, "Circular and linear regression", 2010, chapter 5).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from services.detector.model import Floats

RIM = 0.92
"""Share of the radius beyond which the ray residual is continued linearly."""


@njit(cache=True, nogil=True)
def residual(px: float, py: float, ux: float, uy: float, cx: float, cy: float, r: float, J: Floats) -> float:
    """Return the residual of one point and write its derivatives by (cx, cy, r) to ``J``.

    ``(ux, uy)`` is the unit ray in the plan, or (0, 0) for a radial residual. Positive: the point lies before
    (radially: outside) the surface.
    """
    dx, dy = cx - px, cy - py
    if ux == 0.0 and uy == 0.0:
        d = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        J[0] = dx / d
        J[1] = dy / d
        J[2] = -1.0
        return d - r
    a = dx * ux + dy * uy
    s = dx * uy - dy * ux
    side = 1.0 if s >= 0.0 else -1.0
    rim = RIM * r
    if abs(s) <= rim:
        q = np.sqrt(r * r - s * s)
        J[0] = ux + s / q * uy
        J[1] = uy - s / q * ux
        J[2] = -r / q
        return a - q
    k = RIM / np.sqrt(1.0 - RIM * RIM)
    J[0] = ux + k * side * uy
    J[1] = uy - k * side * ux
    J[2] = -np.sqrt(1.0 - RIM * RIM) - k * RIM
    return a - r * np.sqrt(1.0 - RIM * RIM) + k * (abs(s) - rim)


@njit(cache=True, nogil=True)
def point_sigma(s_share: float, range_m: float, ray: bool, k_range: float, surface: float) -> float:
    """Return the standard deviation of a residual: depth noise, and surface noise seen at a slant.

    ``s_share`` is the distance of the ray from the axis as a share of the radius.
    """
    if not ray:
        return surface
    cosine2 = max(1.0 - s_share * s_share, 0.10)
    depth = k_range * range_m * range_m
    return np.sqrt(depth * depth + surface * surface / cosine2)
