"""Two walls at 3 m before a backdrop at 30 m, beyond the depth camera's range: most that is seen tells a direction alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tests.unit.slam_room import INTRINSICS, rays

F64 = NDArray[np.float64]


def _texture(rng: np.random.Generator) -> F64:
    n = 512
    return (rng.integers(0, 160, (n, n)) + np.kron(rng.integers(0, 96, (n // 4, n // 4)), np.ones((4, 4), int))).astype(
        float
    )


_RNG = np.random.default_rng(3)
_BACK, _LEFT, _RIGHT = _texture(_RNG), _texture(_RNG), _texture(_RNG)

Plane = tuple[float, float, float, F64, float]
"""Of x (m), seen between two y (m), its texture and a texel's side (m)."""
OPEN: list[Plane] = [(30.0, -1e9, 1e9, _BACK, 0.30), (3.0, 0.5, 6.0, _LEFT, 0.04), (3.0, -9.0, -2.3, _RIGHT, 0.04)]
CLOSED: list[Plane] = [(3.0, -1e9, 1e9, _BACK, 0.04), (2.0, -9.0, -2.2, _LEFT, 0.03)]
BEYOND_MAP: list[Plane] = [(9.0, -1e9, 1e9, _BACK, 0.09)]


def _sample(texture: F64, a: F64, b: F64) -> F64:
    i, j = np.floor(a).astype(int), np.floor(b).astype(int)
    p, q, n = a - i, b - j, len(texture)

    def at(x: NDArray[np.int_], y: NDArray[np.int_]) -> F64:
        return texture[x % n, y % n]

    return (
        at(i, j) * (1 - p) * (1 - q)
        + at(i + 1, j) * p * (1 - q)
        + at(i, j + 1) * (1 - p) * q
        + at(i + 1, j + 1) * p * q
    )


def look(
    T_world_camera: F64, planes: list[Plane], noise: np.random.Generator, reach_m: float = 6.0
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return grey (H, W) with a camera's ``noise`` and depth (H, W), 0 beyond ``reach_m``, of planes seen along x."""
    directions, o = rays() @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    best, grey = np.full(len(directions), np.inf), np.zeros(len(directions))
    for x, y_least, y_most, texture, texel_m in planes:
        k = (x - o[0]) / directions[:, 0]
        y, z = o[1] + k * directions[:, 1], o[2] + k * directions[:, 2]
        seen = (k > 0.0) & (k < best) & (y > y_least) & (y < y_most)
        best[seen] = k[seen]
        grey[seen] = _sample(texture, y[seen] / texel_m + 1000.0, z[seen] / texel_m + 1000.0)
    grey += noise.normal(0.0, 2.0, grey.shape)
    shape = (INTRINSICS.height, INTRINSICS.width)
    depth_m = np.where(best < reach_m, best, 0.0).astype(np.float32)
    return np.clip(grey, 0, 255).reshape(shape).astype(np.uint8), depth_m.reshape(shape)
