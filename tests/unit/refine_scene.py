"""An analytic depth camera for tests: tapered, leaning trunks on a plane, with the noise of active stereo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import Matrix, level_camera
from services.detector.refine.model import Depth, ExpectedTree
from services.detector.refine.view import ray_table

CAMERA = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
FAR_M = 12.0


@dataclass(frozen=True)
class Cone:
    """A trunk: radius at 1.3 m, narrowing upward by ``taper`` per metre."""

    x: float
    y: float
    radius: float
    lean: tuple[float, float] = (0.0, 0.0)
    taper: float = 0.008
    bottom: float = -1.0
    top: float = 8.0

    @property
    def axis(self) -> tuple[float, float, float]:
        a = np.array([self.lean[0], self.lean[1], 1.0])
        a /= np.linalg.norm(a)
        return float(a[0]), float(a[1]), float(a[2])

    def at(self, z: float) -> NDArray[np.float64]:
        """Return the axis's (x, y) at height z."""
        return np.array([self.x + self.lean[0] * z, self.y + self.lean[1] * z])

    def expected(
        self, tree_id: int = 0, shift: tuple[float, float] = (0.0, 0.0), sigma: float = 0.05, radius_error: float = 0.0
    ) -> ExpectedTree:
        return ExpectedTree(
            tree_id, self.x + shift[0], self.y + shift[1], 0.0, self.axis, self.radius + radius_error, sigma, 0.01
        )


def depth_of(cone: Cone, T: Matrix, camera: Intrinsics) -> Depth:
    """Return the optical depth (H, W) at which each pixel's ray meets the trunk, infinity where it does not."""
    x, y = ray_table(camera)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64) @ T[:3, :3].T
    o = T[:3, 3] - np.array([cone.x, cone.y, 0.0])
    lean = np.array(cone.lean)
    # the axis at height h is lean * h; the radius there r0 - taper * h: both linear in the depth
    p, q = o[:2] - lean * o[2], rays[..., :2] - lean * rays[..., 2:]
    r0, r1 = cone.radius - cone.taper * (o[2] - 1.3), -cone.taper * rays[..., 2]
    a = np.sum(q * q, axis=-1) - r1 * r1
    b = q @ p - r0 * r1
    c = float(p @ p) - r0 * r0
    disc = b * b - a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        z = (-b - np.sqrt(disc)) / a
    height = T[2, 3] + z * rays[..., 2]
    hit = (disc > 0) & (z > 0.05) & (height > cone.bottom) & (height < cone.top)
    return np.where(hit, z, np.inf).astype(np.float32)


def render(
    cones: Sequence[Cone], T: Matrix, camera: Intrinsics = CAMERA, slope: tuple[float, float] = (0.0, 0.0)
) -> Depth:
    """Return the true depth (H, W) of trunks, ground z = slope . (x, y), and a far wall."""
    x, y = ray_table(camera)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float64) @ T[:3, :3].T
    n = np.array([-slope[0], -slope[1], 1.0])
    with np.errstate(divide="ignore"):
        ground = -(T[:3, 3] @ n) / (rays @ n)
    depth = np.where(ground > 0.05, ground, np.inf)
    depth = np.minimum(depth, FAR_M)
    for cone in cones:
        depth = np.minimum(depth, depth_of(cone, T, camera))
    return depth.astype(np.float32)


def sensed(depth: Depth, seed: int, s_px: float = 0.08, max_m: float = 6.0, mixed_px: int = 2) -> Depth:
    """Return what active stereo makes of a true depth: noise along the ray, part of it a fixed pattern; mixed pixels
    within ``mixed_px`` of depth edges; holes; nothing beyond ``max_m``.
    """  # fmt: skip
    rng = np.random.default_rng(seed)
    pattern = np.random.default_rng(7).normal(size=depth.shape)
    sigma = depth**2 * s_px / (0.07 * 565.0)
    noisy = depth + sigma * (0.8 * rng.normal(size=depth.shape) + 0.6 * pattern)
    reach = mixed_px
    low, high = depth.copy(), depth.copy()
    for k in range(1, reach + 1):
        for shifted in (np.roll(depth, k, axis=1), np.roll(depth, -k, axis=1)):
            low, high = np.minimum(low, shifted), np.maximum(high, shifted)
    edge = high - low > 0.15
    share = rng.uniform(size=depth.shape)
    noisy = np.where(edge & (rng.uniform(size=depth.shape) < 0.6), low + share * (high - low), noisy)
    holes = (rng.uniform(size=depth.shape) < 0.02) | (edge & (rng.uniform(size=depth.shape) < 0.3))
    out = np.where(holes | (noisy > max_m) | (noisy < 0.4), 0.0, noisy)
    return np.asarray(np.round(out * 1000.0) / 1000.0, dtype=np.float32)


def camera_at(x: float = 0.0, y: float = 0.0, z: float = 1.5, yaw: float = 0.0) -> Matrix:
    return level_camera((x, y, z), yaw)
