"""Compiled: sums of all frames' points per voxel, and the surface that they scatter about along their rays."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.kernels import slot_of
from services.fine.stem_kernels import nearest_stem

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Keys = NDArray[np.int64]
Table = NDArray[np.int32]

# columns of the sums: weight, weighted offset from the voxel's middle (3), weighted unit ray (3), weighted range, colour (3), count
WEIGHT, OFFSET, RAY, RANGE, COLOUR, COUNT = 0, 1, 4, 7, 8, 11
COLUMNS = 12
_HALF = 1 << 19
_SIDE = np.int64(1 << 20)


@njit(cache=True, nogil=True)
def voxel_key(x: float, y: float, z: float, voxel: float, level: int) -> np.int64:
    """Return the number of the voxel that holds a point; ``level`` 0 fine, 1 coarse."""
    a = np.int64(np.floor(x / voxel)) + _HALF
    b = np.int64(np.floor(y / voxel)) + _HALF
    c = np.int64(np.floor(z / voxel)) + _HALF
    return ((a * _SIDE + b) * _SIDE + c) * np.int64(2) + np.int64(level)


@njit(cache=True, nogil=True)
def middle_of(key: np.int64, fine: float, coarse: float, out: Floats) -> int:
    """Write the middle of a voxel and return its level."""
    level = int(key & 1)
    voxel = fine if level == 0 else coarse
    rest = key >> 1
    out[2] = (float(rest % _SIDE - _HALF) + 0.5) * voxel
    rest //= _SIDE
    out[1] = (float(rest % _SIDE - _HALF) + 0.5) * voxel
    out[0] = (float(rest // _SIDE - _HALF) + 0.5) * voxel
    return level


@njit(cache=True, nogil=True)
def add_points(
    points: Floats32, rgb: NDArray[np.uint8], T: Floats, stems: Floats, settings: Floats, table: Table, keys: Keys,
    sums: Floats32, held: int, stem_of: NDArray[np.int16], placed: Floats32,
) -> tuple[int, int]:  # fmt: skip
    """Add a frame's points (N, 3), camera frame, to the sums; return how many voxels are held now, and points left out.

    ``settings``: fine and coarse leaf, reach around stems, noise per square metre, noise floor. ``stem_of`` (N,) gets the
    stem that each point is near, ``placed`` (N, 3) where it is in map.
    """
    fine, coarse, reach, k_range, floor = settings
    middle = np.empty(3)
    left_out = 0
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        rx = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz
        ry = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz
        rz = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz
        x, y, z = rx + T[0, 3], ry + T[1, 3], rz + T[2, 3]
        stem = nearest_stem(x, y, z, stems, reach)
        stem_of[i] = stem
        placed[i, 0], placed[i, 1], placed[i, 2] = x, y, z
        level = 0 if stem >= 0 else 1
        key = voxel_key(x, y, z, fine if level == 0 else coarse, level)
        at = slot_of(table, keys, key)
        j = table[at]
        if j < 0:
            if held >= keys.shape[0]:
                left_out += 1
                continue
            j = held
            table[at] = j
            keys[j] = key
            sums[j, :] = 0.0
            held += 1
        r = np.sqrt(rx * rx + ry * ry + rz * rz)
        sigma = k_range * r * r
        w = 1.0 / (sigma * sigma + floor * floor)
        middle_of(key, fine, coarse, middle)
        s = sums[j]
        s[WEIGHT] += w
        s[OFFSET] += w * (x - middle[0])
        s[OFFSET + 1] += w * (y - middle[1])
        s[OFFSET + 2] += w * (z - middle[2])
        s[RAY] += w * rx / r
        s[RAY + 1] += w * ry / r
        s[RAY + 2] += w * rz / r
        s[RANGE] += w * r
        for c in range(3):
            s[COLOUR + c] += rgb[i, c]
        s[COUNT] += 1.0
    return held, left_out


@njit(cache=True, nogil=True)
def fill_table(table: Table, keys: Keys) -> None:
    """Enter keys, all different, into an empty table."""
    for j in range(keys.shape[0]):
        table[slot_of(table, keys, keys[j])] = j


@njit(cache=True, nogil=True)
def _ray_step(s: Floats32, voxel: float, step: Floats) -> None:
    """Write the voxel's mean ray, as long as a voxel."""
    length = np.sqrt(s[RAY] ** 2 + s[RAY + 1] ** 2 + s[RAY + 2] ** 2)
    for c in range(3):
        step[c] = voxel * s[RAY + c] / max(length, 1e-9)


@njit(cache=True, nogil=True)
def _reach_of(s: Floats32, voxel: float, k_range: float, floor: float, sigmas: float) -> int:
    r = s[RANGE] / s[WEIGHT]
    sigma = np.sqrt((k_range * r * r) ** 2 + floor * floor)
    return max(1, int(sigmas * sigma / voxel))


@njit(cache=True, nogil=True)
def densities(table: Table, keys: Keys, sums: Floats32, settings: Floats, out: Floats32) -> None:
    """Fill ``out`` (V,) with the weight within one sigma along each voxel's ray."""
    fine, coarse, _, k_range, floor = settings
    middle, step = np.empty(3), np.empty(3)
    for j in range(keys.shape[0]):
        level = middle_of(keys[j], fine, coarse, middle)
        voxel = fine if level == 0 else coarse
        _ray_step(sums[j], voxel, step)
        total = 0.0
        reach = _reach_of(sums[j], voxel, k_range, floor, 1.0)
        for q in range(-reach, reach + 1):
            key = voxel_key(middle[0] + q * step[0], middle[1] + q * step[1], middle[2] + q * step[2], voxel, level)
            k = table[slot_of(table, keys, key)]
            total += sums[k, WEIGHT] if k >= 0 else 0.0
        out[j] = total


@njit(cache=True, nogil=True)
def surface(
    table: Table, keys: Keys, sums: Floats32, density: Floats32, settings: Floats, least: int, points: Floats,
    rgb: NDArray[np.uint8], level_of: NDArray[np.uint8],
) -> int:  # fmt: skip
    """Write the points of the surface and return their number.

    They are the voxels that are densest along their ray, moved to the weighted mean of what scatters about them there.
    Places that fewer than ``least`` pixels saw (coarse: two thirds) are none.
    """
    fine, coarse, _, k_range, floor = settings
    middle, step, place = np.empty(3), np.empty(3), np.empty(3)
    m = 0
    for j in range(keys.shape[0]):
        level = middle_of(keys[j], fine, coarse, middle)
        voxel = fine if level == 0 else coarse
        _ray_step(sums[j], voxel, step)
        near, far = _reach_of(sums[j], voxel, k_range, floor, 1.5), _reach_of(sums[j], voxel, k_range, floor, 2.5)
        total, count, along, best = 0.0, 0.0, 0.0, True
        for q in range(-far, far + 1):
            key = voxel_key(middle[0] + q * step[0], middle[1] + q * step[1], middle[2] + q * step[2], voxel, level)
            k = table[slot_of(table, keys, key)]
            if k < 0 or k == j:
                continue
            if density[k] > density[j] or (density[k] == density[j] and k < j):
                best = False
                break
            if abs(q) <= near:
                total += sums[k, WEIGHT]
                count += sums[k, COUNT]
                along += sums[k, WEIGHT] * q
        count += sums[j, COUNT]
        if not best or count < (least if level == 0 else (2 * least) // 3):
            continue
        total += sums[j, WEIGHT]
        for c in range(3):
            own = sums[j, OFFSET + c] / sums[j, WEIGHT]
            place[c] = middle[c] + own + along / total * step[c]
            points[m, c] = place[c]
            rgb[m, c] = np.uint8(min(255.0, sums[j, COLOUR + c] / sums[j, COUNT] + 0.5))
        level_of[m] = level
        m += 1
    return m
