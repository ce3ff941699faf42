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

Colour = tuple[float, float, float]

# Per material: dark and light colour, flake colour (BGR 0..255), cell length (x, y, z) of the coarsest octave in
# metres, flake length in metres, share of flakes.
_ROWS: tuple[tuple[Colour, Colour, Colour, tuple[float, float, float], float, float], ...] = (
    ((28, 42, 52), (72, 112, 124), (96, 150, 178), (0.9, 0.9, 0.9), 0.045, 0.30),  # GROUND
    ((26, 34, 46), (92, 112, 138), (150, 164, 176), (0.16, 0.16, 0.75), 0.030, 0.22),  # BARK
    ((22, 58, 28), (62, 142, 84), (110, 196, 150), (0.30, 0.30, 0.30), 0.035, 0.30),  # LEAF
    ((60, 84, 108), (118, 150, 176), (48, 62, 80), (0.20, 0.20, 0.60), 0.035, 0.18),  # WOOD
    ((24, 34, 30), (86, 118, 108), (140, 166, 160), (1.6, 1.6, 7.0), 0.45, 0.30),  # BACKDROP
    ((80, 40, 36), (150, 96, 70), (190, 180, 200), (0.25, 0.25, 0.25), 0.040, 0.15),  # CLOTH
)


def palette() -> NDArray[np.float32]:
    """Return the materials as a table (materials, 14) for the kernel."""
    return np.array([[*dark, *light, *flake, *cell, size, share] for dark, light, flake, cell, size, share in _ROWS],
                    dtype=np.float32)  # fmt: skip


def lattice(seed: int) -> NDArray[np.float32]:
    """Return random values 0..1 on the lattice, flat (LATTICE^3,)."""
    return np.random.default_rng([seed, 11]).random(LATTICE**3, dtype=np.float32)


@njit(cache=True, nogil=True, inline="always")
def _at(table: NDArray[np.float32], i: int, j: int, k: int) -> np.float32:
    return np.float32(table[((i & _MASK) * LATTICE + (j & _MASK)) * LATTICE + (k & _MASK)])


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _brightness(
    table: NDArray[np.float32], row: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32,
    pixel_m: np.float32,
) -> tuple[np.float32, np.float32]:  # fmt: skip
    """Return brightness 0..1 of a point, and the second octave; a pixel covers ``pixel_m`` there."""
    sx, sy, sz = x / row[9], y / row[10], z / row[11]
    cell = row[9]
    total, weight, amplitude, warp = _ZERO, _ZERO, _ONE, _HALF
    for octave in range(4):
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


@njit(cache=True, nogil=True)
def _flake(
    table: NDArray[np.float32], row: NDArray[np.float32], x: np.float32, y: np.float32, z: np.float32,
    pixel_m: np.float32, warp: np.float32,
) -> np.float32:  # fmt: skip
    """Return how much of a flake's colour a point has, 0..1."""
    size = row[12]
    fade = min(_ONE, max(_ZERO, size / pixel_m - np.float32(0.8)))
    if fade <= _ZERO:
        return _ZERO
    shift = np.float32(1.3) * warp
    tall = size * min(row[11] / row[9], np.float32(2.5))
    i = int(np.floor(x / size + shift))
    j = int(np.floor(y / size + np.float32(0.7) * x / size + shift))
    k = int(np.floor(z / tall - shift))
    pick = _at(table, i, j, k)
    if pick >= row[13]:
        return _ZERO
    return np.float32(fade * (np.float32(0.35) + np.float32(0.65) * pick / row[13]))


@njit(cache=True, nogil=True)
def _sky(table: NDArray[np.float32], dx: float, dy: float, dz: float, pixel: NDArray[np.uint8]) -> None:
    up = dz / np.sqrt(dx * dx + dy * dy + dz * dz)
    x, y = 6.0 * dx / (abs(dz) + 0.3), 6.0 * dy / (abs(dz) + 0.3)
    cloud = 40.0 * smooth_noise(table, np.float32(x), np.float32(y), np.float32(3.0)) * max(0.0, up)
    pixel[0] = np.uint8(min(255.0, 225.0 - 30.0 * up + cloud))
    pixel[1] = np.uint8(min(255.0, 212.0 - 55.0 * up + cloud))
    pixel[2] = np.uint8(min(255.0, 205.0 - 85.0 * up + cloud))


@njit(cache=True, nogil=True)
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
            flake = _flake(table, row, x, y, z, t * pixel_rad, warp)
            nx, ny, nz = normal[v, u, 0], normal[v, u, 1], normal[v, u, 2]
            light = nx * sun[0] + ny * sun[1] + nz * sun[2]
            if nx * dx + ny * dy + nz * dz > _ZERO:  # the triangle's back
                light = -light
            tint = np.float32(0.85) + np.float32(0.3) * _at(table, p, 7, 3)
            shade = tint * (np.float32(0.62) + np.float32(0.45) * max(_ZERO, light))
            haze = min(np.float32(0.55), max(_ZERO, (t - np.float32(5.0)) / np.float32(60.0)))
            for c in range(3):
                base = row[c] + bright * (row[3 + c] - row[c])
                base += flake * (row[6 + c] - base)
                base *= shade
                base += haze * (np.float32(195.0) - base)
                out[v, u, c] = np.uint8(min(np.float32(255.0), max(_ZERO, base)))
