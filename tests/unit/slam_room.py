"""A box room with noise on its walls, seen by a perfect RGB-D camera: exact truth for slam's tests."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import level_camera

F64 = NDArray[np.float64]

INTRINSICS = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
_HALF_M = np.array([3.0, 2.5, 1.5])
_TEXEL_M = 0.05


@cache
def _walls() -> NDArray[np.uint8]:
    rng = np.random.default_rng(7)
    fine = rng.integers(0, 160, (6, 160, 160))
    coarse = np.kron(rng.integers(0, 96, (6, 40, 40)), np.ones((1, 4, 4), int))
    return (fine + coarse).astype(np.uint8)


@cache
def rays() -> F64:
    """Return (H * W, 3) where each pixel looks in the camera's axes, z = 1."""
    i = INTRINSICS
    u, v = np.meshgrid(np.arange(i.width), np.arange(i.height))
    return np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)


def look(T_world_camera: F64, rows: slice = slice(None)) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return ``rows`` of grey (H, W) and depth (H, W), metres, seen from a pose inside the room (centre at the origin)."""
    seen_along = rays().reshape(INTRINSICS.height, INTRINSICS.width, 3)[rows].reshape(-1, 3)
    d = seen_along @ T_world_camera[:3, :3].T
    o = T_world_camera[:3, 3]
    with np.errstate(divide="ignore"):
        reach = (np.where(d > 0.0, _HALF_M, -_HALF_M) - o) / d
    axis = np.argmin(reach, axis=1)
    depth = reach[np.arange(len(d)), axis]
    hit = o + depth[:, None] * d
    side = axis * 2 + (d[np.arange(len(d)), axis] > 0.0)
    first, second = hit[np.arange(len(d)), (axis + 1) % 3], hit[np.arange(len(d)), (axis + 2) % 3]
    a, b = (first + 3.2) / _TEXEL_M, (second + 3.2) / _TEXEL_M
    i, j = np.floor(a).astype(int), np.floor(b).astype(int)
    p, q = a - i, b - j
    walls = _walls()
    grey = (
        walls[side, i, j] * (1 - p) * (1 - q) + walls[side, i + 1, j] * p * (1 - q)
        + walls[side, i, j + 1] * (1 - p) * q + walls[side, i + 1, j + 1] * p * q
    )  # fmt: skip
    shape = (-1, INTRINSICS.width)
    return grey.reshape(shape).astype(np.uint8), depth.reshape(shape).astype(np.float32)


def turn_on_the_spot(frames: int, degrees: float) -> list[F64]:
    """Return T_world_camera of a level turn with a slight sway."""
    out = []
    for k in range(frames):
        yaw = np.radians(degrees) * k / max(frames - 1, 1)
        out.append(level_camera([0.02 * np.sin(0.3 * k), 0.02 * np.cos(0.21 * k) - 0.02, 0.0], yaw))
    return out
