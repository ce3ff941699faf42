"""Compiled stages of the depth pipeline. Images are (H, W) float32 of inverse depth (1/m), zero where no data is."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]

_MIN_WEIGHT = 0.01
"""A hole whose grey is four sigma off both neighbours' is not of their surface."""


@njit(cache=True, nogil=True)
def to_inverse(depth_m: Image, min_m: float, max_m: float, out: Image) -> None:
    """Write the inverse of each depth within the range; anything else, NaN too, becomes zero."""
    for v in range(depth_m.shape[0]):
        for u in range(depth_m.shape[1]):
            z = depth_m[v, u]
            out[v, u] = np.float32(1.0) / z if (z >= min_m and z <= max_m) else np.float32(0.0)


@njit(cache=True, nogil=True)
def to_depth(inverse: Image, out: Image) -> None:
    """Write the depth of each inverse depth; zero stays zero."""
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            w = inverse[v, u]
            out[v, u] = np.float32(1.0) / w if w > 0.0 else np.float32(0.0)


@njit(cache=True, nogil=True)
def drop_mixed(
    inverse: Image, row_max: Image, row_min: Image, column_max: Image, column_min: Image, noise: float, gap_m: float,
    reach: int, out: Image,
) -> None:  # fmt: skip
    """Copy, leaving out pixels that hang between two surfaces.

    A pixel is mixed when, along the row or the column, one side within ``reach`` is nearer and the other side farther,
    each by more than noise explains (``noise``, 1/m) and by more than ``gap_m``: a round trunk or the ground at a slant
    changes by less. Beside an object the sensor is often blind: a side without any data within ``reach`` agrees with
    whatever the other side says.

    ``row_max`` ...: the largest and smallest value within ``reach`` along row and column; few pixels need more than them.
    """
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            w = inverse[v, u]
            out[v, u] = w
            if w == 0.0:
                continue
            step = max(noise, gap_m * w * w)
            across = row_max[v, u] - w > step and w - row_min[v, u] > step
            along = column_max[v, u] - w > step and w - column_min[v, u] > step
            if (across and _hangs(inverse, v, u, 0, 1, step, reach)) or (
                along and _hangs(inverse, v, u, 1, 0, step, reach)
            ):
                out[v, u] = 0.0


@njit(cache=True, nogil=True)
def _hangs(inverse: Image, v: int, u: int, dv: int, du: int, step: float, reach: int) -> bool:
    """Return whether the pixel lies between its two sides along (dv, du)."""
    near_before, far_before, data_before, blind_before = _side(inverse, v, u, -dv, -du, step, reach)
    near_behind, far_behind, data_behind, blind_behind = _side(inverse, v, u, dv, du, step, reach)
    between = (near_before and far_behind) or (near_behind and far_before)
    beside_blind = (near_before and blind_behind and not data_behind) or (
        near_behind and blind_before and not data_before
    )
    return between or beside_blind


@njit(cache=True, nogil=True)
def _side(inverse: Image, v: int, u: int, dv: int, du: int, step: float, reach: int) -> tuple[bool, bool, bool, bool]:
    """Return whether a side has data nearer by ``step``, farther by ``step``, any data, any pixel without."""
    near, far, data, blind = False, False, False, False
    w = inverse[v, u]
    for k in range(1, reach + 1):
        y, x = v + k * dv, u + k * du
        if y < 0 or x < 0 or y >= inverse.shape[0] or x >= inverse.shape[1]:
            break
        other = inverse[y, x]
        if other > 0.0:
            data = True
            near = near or other - w > step
            far = far or w - other > step
        else:
            blind = True
    return near, far, data, blind


@njit(cache=True, nogil=True)
def fill_holes(
    inverse: Image, grey: Grey, guided: bool, reach: int, grey_sigma: float, same: float, out: Image
) -> None:
    """Copy, filling holes between valid pixels of one surface: between, never beyond, and never across objects.

    The nearest data to the left and right make a pair, those above and below another. A pair counts when its two lie
    on one surface (within ``same``). The hole gets their mean weighted by distance and by grey difference (joint
    bilateral: Petschnigg et al. 2004, Eisemann and Durand 2004); where grey says it is neither's, it stays a hole.
    """
    height, width = inverse.shape
    below = _nearest_below(inverse, reach)
    above = np.full(width, -1 - reach, np.int64)
    right = np.empty(width, np.int64)
    for v in range(height):
        _nearest_right(inverse[v], right)
        left = -1 - reach
        for u in range(width):
            w = inverse[v, u]
            if w > 0.0:
                out[v, u] = w
                above[u], left = v, u
                continue
            out[v, u] = 0.0
            total, weight = 0.0, 0.0
            if u - left <= reach and right[u] - u <= reach:
                total, weight = _pair(inverse, grey, guided, v, u, v, left, v, right[u], reach, grey_sigma, same)
            if v - above[u] <= reach and below[v, u] > 0:
                t, m = _pair(inverse, grey, guided, v, u, above[u], u, v + below[v, u], u, reach, grey_sigma, same)
                total, weight = total + t, weight + m
            if weight > _MIN_WEIGHT:
                out[v, u] = total / weight


@njit(cache=True, nogil=True)
def _nearest_below(inverse: Image, reach: int) -> NDArray[np.uint8]:
    """Return how many rows further down each pixel's next data are, zero when beyond ``reach``."""
    height, width = inverse.shape
    steps = np.zeros((height, width), np.uint8)
    for v in range(height - 2, -1, -1):
        for u in range(width):
            if inverse[v + 1, u] > 0.0:
                steps[v, u] = 1
            elif 0 < steps[v + 1, u] < reach:
                steps[v, u] = steps[v + 1, u] + 1
    return steps


@njit(cache=True, nogil=True)
def _nearest_right(row: Image, right: NDArray[np.int64]) -> None:
    """Fill the column of the next data to the right of each pixel, far away where there are none."""
    last = 1 << 30
    for u in range(row.size - 1, -1, -1):
        right[u] = last
        if row[u] > 0.0:
            last = u


@njit(cache=True, nogil=True)
def _pair(
    inverse: Image, grey: Grey, guided: bool, v: int, u: int, v0: int, u0: int, v1: int, u1: int, reach: int,
    grey_sigma: float, same: float,
) -> tuple[float, float]:  # fmt: skip
    """Return (weighted sum, weight) of a hole's two neighbours, zeros when they are of two surfaces."""
    first, second = inverse[v0, u0], inverse[v1, u1]
    if abs(first - second) > same:
        return 0.0, 0.0
    near, far = float(abs(v - v0) + abs(u - u0)), float(abs(v1 - v) + abs(u1 - u))
    a, b = far / (near + far), near / (near + far)
    if guided:
        own = float(grey[v, u])
        da, db = (float(grey[v0, u0]) - own) / grey_sigma, (float(grey[v1, u1]) - own) / grey_sigma
        a *= math.exp(-0.5 * da * da)
        b *= math.exp(-0.5 * db * db)
    shorter = math.exp(-(((near + far) / (2.0 * reach)) ** 2))
    return shorter * (a * first + b * second), shorter * (a + b)


@njit(cache=True, nogil=True)
def blend(inverse: Image, past: Image, share: float, same: float, out: Image) -> None:
    """Average with the past where a pixel changed by no more than ``same``; a changed pixel forgets its past."""
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            w, p = inverse[v, u], past[v, u]
            if w > 0.0 and p > 0.0 and abs(w - p) <= same:
                w = np.float32(w + share * (p - w))
            out[v, u] = w


@njit(cache=True, nogil=True)
def splat(
    depth_m: Image, ray_x: Image, ray_y: Image, T: NDArray[np.float64], k: NDArray[np.float64], out: Image
) -> None:
    """Register depth to another camera: move each pixel's point by ``T`` (4, 4) and draw it, the nearest wins.

    ``k``: fx fy cx cy of the target (its width and height are ``out``'s), the source's fx, the target's k1 k2 p1 p2 k3, and
    the source's fy. A pixel is drawn with the size it has in the target, so that a finer target image has no gaps.
    """
    height, width = out.shape
    out[:] = 0.0
    for v in range(depth_m.shape[0]):
        for u in range(depth_m.shape[1]):
            z = depth_m[v, u]
            if not z > 0.0:
                continue
            x, y = ray_x[v, u] * z, ray_y[v, u] * z
            zt = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            if not zt > 0.05:
                continue
            xt = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / zt
            yt = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / zt
            r2 = xt * xt + yt * yt
            radial = 1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[9]))
            ut = k[0] * (xt * radial + 2.0 * k[7] * xt * yt + k[8] * (r2 + 2.0 * xt * xt)) + k[2]
            vt = k[1] * (yt * radial + k[7] * (r2 + 2.0 * yt * yt) + 2.0 * k[8] * xt * yt) + k[3]
            half_u, half_v = 0.5 * k[0] / k[4] * z / zt, 0.5 * k[1] / k[10] * z / zt
            first_u, last_u = max(math.ceil(ut - half_u), 0), min(math.floor(ut + half_u), width - 1)
            first_v, last_v = max(math.ceil(vt - half_v), 0), min(math.floor(vt + half_v), height - 1)
            for b in range(first_v, last_v + 1):
                for a in range(first_u, last_u + 1):
                    if out[b, a] == 0.0 or zt < out[b, a]:
                        out[b, a] = zt
