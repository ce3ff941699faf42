"""Colour of a surface point from solid noise: a function of where the point is, so it looks the same from everywhere.

Smooth noise is Perlin's lattice ("An image synthesizer", 1985) in its simplest form, random values joined by
trilinear interpolation, in octaves. Flakes (litter, bark plates, leaves) are cells of warped space with a colour
each. What would be finer than a pixel fades out, so nothing flickers as the camera moves.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

GROUND, BARK, LEAF, WOOD, BACKDROP, CLOTH = range(6)

LATTICE = 64
"""Side of the noise lattice; it repeats after that many cells."""
_MASK = LATTICE - 1
_ENTRIES = LATTICE**3 - 1

_FAST = {"contract", "arcp", "nsz"}
"""Floating point freedoms that keep infinities and the order of sums."""

Colour = tuple[float, float, float]

# Per material: dark and light colour, flake colour (BGR 0..255), cell length (x, y, z) of the coarsest octave in
# metres, flake length in metres, share of flakes.
_ROWS: tuple[tuple[Colour, Colour, Colour, tuple[float, float, float], float, float], ...] = (
    ((20, 32, 40), (74, 116, 130), (120, 178, 208), (0.7, 0.7, 0.7), 0.085, 0.45),  # GROUND
    ((20, 28, 38), (96, 116, 142), (160, 176, 190), (0.16, 0.16, 0.75), 0.055, 0.45),  # BARK
    ((22, 58, 28), (62, 142, 84), (110, 196, 150), (0.30, 0.30, 0.30), 0.060, 0.45),  # LEAF
    ((60, 84, 108), (118, 150, 176), (48, 62, 80), (0.20, 0.20, 0.60), 0.060, 0.40),  # WOOD
    ((34, 46, 42), (92, 120, 110), (118, 146, 138), (1.6, 1.6, 7.0), 1.1, 0.40),  # BACKDROP
    ((80, 40, 36), (150, 96, 70), (190, 180, 200), (0.25, 0.25, 0.25), 0.060, 0.30),  # CLOTH
)


def palette() -> NDArray[np.float32]:
    """Return the materials as a table (materials, 14) for the kernel."""
    return np.array([[*dark, *light, *flake, *cell, size, share] for dark, light, flake, cell, size, share in _ROWS],
                    dtype=np.float32)  # fmt: skip


def lattice(seed: int) -> NDArray[np.float32]:
    """Return random values 0..1 on the lattice, flat (LATTICE^3,)."""
    return np.random.default_rng([seed, 11]).random(LATTICE**3, dtype=np.float32)


@njit(cache=True, nogil=True, inline="always")
def _mixed(i: int, j: int, k: int) -> int:
    """Return a number that looks random for each cell: unlike the lattice, flakes never repeat."""
    h = (i * 73856093) ^ (j * 19349663) ^ (k * 83492791)
    h ^= (h >> 13) & 0x7FFFF
    return (h * 1540483477 & 0x7FFFFFFFFFFF) >> 8


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _at(table: NDArray[np.float32], i: int, j: int, k: int) -> np.float32:
    return np.float32(table[((i & _MASK) * LATTICE + (j & _MASK)) * LATTICE + (k & _MASK)])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def smooth_noise(table: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32) -> np.float32:
    """Return trilinear noise, 0..1, at lattice coordinates."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    i0, i1 = (i & _MASK) * LATTICE * LATTICE, ((i + 1) & _MASK) * LATTICE * LATTICE
    j0, j1 = (j & _MASK) * LATTICE, ((j + 1) & _MASK) * LATTICE
    k0, k1 = k & _MASK, (k + 1) & _MASK
    a = table[i0 + j0 + k0] + w * (table[i0 + j0 + k1] - table[i0 + j0 + k0])
    b = table[i0 + j1 + k0] + w * (table[i0 + j1 + k1] - table[i0 + j1 + k0])
    c = table[i1 + j0 + k0] + w * (table[i1 + j0 + k1] - table[i1 + j0 + k0])
    d = table[i1 + j1 + k0] + w * (table[i1 + j1 + k1] - table[i1 + j1 + k0])
    a += v * (b - a)
    c += v * (d - c)
    return np.float32(a + u * (c - a))


_SHRINK = np.float32(0.36)
"""Cell length of an octave as a share of the one before."""
_HALF, _ONE = np.float32(0.5), np.float32(1.0)
_ZERO = np.float32(0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _brightness(
    table: NDArray[np.float32], row: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32,
    pixel_m: np.float32,
) -> tuple[np.float32, np.float32]:  # fmt: skip
    """Return brightness 0..1 of a point, and the second octave; a pixel covers ``pixel_m`` there."""
    sx, sy, sz = x / row[9], y / row[10], z / row[11]
    cell = row[9]
    total, weight, amplitude, warp = _ZERO, _ZERO, _ONE, _HALF
    for octave in range(5):
        fade = min(_ONE, max(_ZERO, _HALF * cell / pixel_m - _HALF))
        if fade <= _ZERO:
            break
        shift = np.float32(17.3) * np.float32(octave)
        value = smooth_noise(table, sx + shift, sy + shift, sz + shift)
        if octave == 1:
            warp = value
        total += amplitude * fade * (value - _HALF)
        weight += amplitude
        amplitude *= np.float32(0.75)
        cell *= _SHRINK
        sx, sy, sz = sx / _SHRINK, sy / _SHRINK, sz / _SHRINK
    contrast = np.float32(2.6) * total / max(weight, np.float32(1e-6))
    return min(_ONE, max(_ZERO, _HALF + contrast)), warp


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _flake(
    table: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32, size: np.float32, tall: np.float32,
    share: np.float32, pixel_m: np.float32,
) -> np.float32:  # fmt: skip
    """Return how much of a flake's colour a point has, 0..1: an ellipse in some of the cells, its edge a pixel soft."""
    fade = min(_ONE, max(_ZERO, size / pixel_m - np.float32(1.5)))
    if fade <= _ZERO:
        return _ZERO
    sx, sy, sz = x / size, y / size + np.float32(0.37) * x / size, z / tall
    fx, fy, fz = np.floor(sx), np.floor(sy), np.floor(sz)
    mixed = _mixed(int(fx), int(fy), int(fz))
    pick = table[mixed & _ENTRIES]
    if pick >= share:
        return _ZERO
    turn = np.float32(2.0) * table[(mixed >> 7) & _ENTRIES] - _ONE
    norm = _ONE / (_ONE + turn * turn)
    cosine, sine = (_ONE - turn * turn) * norm, np.float32(2.0) * turn * norm
    aside = np.float32(0.24) * table[(mixed >> 3) & _ENTRIES] - np.float32(0.12)
    a, b, c = sx - fx - _HALF - aside, sy - fy - _HALF + aside, sz - fz - _HALF
    along, across = cosine * a + sine * b, cosine * b - sine * a
    radius = np.sqrt(np.float32(5.0) * along * along + np.float32(14.0) * across * across + np.float32(4.0) * c * c)
    edge = (_ONE - radius) * size / (np.float32(3.0) * pixel_m)
    inside = min(_ONE, max(_ZERO, edge + _HALF))
    return np.float32(fade * inside * (np.float32(0.4) + np.float32(0.6) * pick / share))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _sky(table: NDArray[np.float32], dx: float, dy: float, dz: float, pixel: NDArray[np.uint8]) -> None:
    up = dz / np.sqrt(dx * dx + dy * dy + dz * dz)
    x, y = 6.0 * dx / (abs(dz) + 0.3), 6.0 * dy / (abs(dz) + 0.3)
    cloud = 40.0 * smooth_noise(table, np.float32(x), np.float32(y), np.float32(3.0)) * max(0.0, up)
    pixel[0] = np.uint8(min(255.0, 225.0 - 30.0 * up + cloud))
    pixel[1] = np.uint8(min(255.0, 212.0 - 55.0 * up + cloud))
    pixel[2] = np.uint8(min(255.0, 205.0 - 85.0 * up + cloud))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def paint(
    table: NDArray[np.float32], rows: NDArray[np.float32], material: NDArray[np.int64], rays: NDArray[np.float32],
    distance: NDArray[np.float32], part: NDArray[np.uint32], normal: NDArray[np.float32], sun: NDArray[np.float32],
    pixel_rad: np.float32, out: NDArray[np.uint8],
) -> None:  # fmt: skip
    """Colour each ray of an image: BGR into ``out`` (H, W, 3) from rays (H, W, 6) and their hits (H, W)."""
    height, width = distance.shape
    for v in range(height):
        for u in range(width):
            t = distance[v, u]
            dx, dy, dz = rays[v, u, 3], rays[v, u, 4], rays[v, u, 5]
            if not np.isfinite(t):
                _sky(table, dx, dy, dz, out[v, u])
                continue
            x, y, z = rays[v, u, 0] + t * dx, rays[v, u, 1] + t * dy, rays[v, u, 2] + t * dz
            p = int(part[v, u])
            row = rows[material[p]]
            bright, warp = _brightness(table, row, x, y, z, t * pixel_rad)
            size, tall = row[12], row[12] * min(row[11] / row[9], np.float32(1.8))
            bend = size * warp  # what lies on the coarser pattern follows it
            flake = _flake(table, x + bend, y - bend, z + bend, size, tall, row[13], t * pixel_rad)
            if flake <= _ZERO:
                fine = np.float32(0.31)
                flake = -_flake(table, y, x, z, fine * size, fine * tall, row[13], t * pixel_rad)
            nx, ny, nz = normal[v, u, 0], normal[v, u, 1], normal[v, u, 2]
            light = nx * sun[0] + ny * sun[1] + nz * sun[2]
            if nx * dx + ny * dy + nz * dz > _ZERO:  # the triangle's back
                light = -light
            tint = np.float32(0.85) + np.float32(0.3) * _at(table, p, 7, 3)
            shade = tint * (np.float32(0.62) + np.float32(0.45) * max(_ZERO, light))
            haze = min(np.float32(0.6), max(_ZERO, (t - np.float32(5.0)) / np.float32(45.0)))
            for c in range(3):
                base = row[c] + bright * (row[3 + c] - row[c])
                if flake >= _ZERO:
                    base += flake * (row[6 + c] - base)
                else:  # the fine flakes are dark
                    base += np.float32(-0.8) * flake * (np.float32(0.5) * row[c] - base)
                base *= shade
                base += haze * (np.float32(195.0) - base)
                out[v, u, c] = np.uint8(min(np.float32(255.0), max(_ZERO, base)))
