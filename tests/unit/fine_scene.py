"""A tapered, leaning stem seen from one side by a depth camera whose noise lies along the ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ConeStem:
    """Diameter ``d`` at 1.3 m above z 0, changing by ``taper`` per metre of height; leaning."""

    x: float = 2.0
    y: float = 0.3
    d: float = 0.24
    taper: float = -0.016
    lean: tuple[float, float] = (0.04, -0.03)

    def centre(self, z: Floats) -> Floats:
        return np.stack([self.x + self.lean[0] * z, self.y + self.lean[1] * z, z], axis=-1)

    def diameter(self, z: Floats) -> Floats:
        return self.d + self.taper * (z - 1.3)

    def tree(self, error: float = 0.0) -> Tree:
        axis = np.array([*self.lean, 1.0]) / np.sqrt(1.0 + self.lean[0] ** 2 + self.lean[1] ** 2)
        return Tree(
            id=4, x_m=self.x + error, y_m=self.y - error, z_m=0.0, axis=(float(axis[0]), float(axis[1]), float(axis[2])),
            radius_m=0.5 * self.d + 0.5 * error, radius_height_m=1.3, height_seen_m=2.6, sigma_xy_m=0.01, sigma_radius_m=0.03,
            arc_rad=1.6, confidence=0.9, observations=9, suitable=True,
        )  # fmt: skip


def seen_from(
    stem: ConeStem, origins: Floats, per_frame: int, seed: int, noise: float = 0.002
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return points (N, 3) on the side that shows from each origin (F, 3), with noise along the rays, and their frames."""
    rng = np.random.default_rng(seed)
    points, frames = [], []
    for f, origin in enumerate(origins):
        z = rng.uniform(0.1, 2.6, per_frame)
        centre, radius = stem.centre(z), 0.5 * stem.diameter(z)
        toward = np.arctan2(origin[1] - centre[:, 1], origin[0] - centre[:, 0])
        angle = toward + np.arcsin(rng.uniform(-0.95, 0.95, per_frame))
        p = centre + radius[:, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros(per_frame)], axis=1)
        ray = p - origin
        distance = np.linalg.norm(ray, axis=1)
        p += ray / distance[:, None] * (noise * distance**2 * rng.normal(size=per_frame))[:, None]
        points.append(p)
        frames.append(np.full(per_frame, f, dtype=np.int32))
    return np.concatenate(points).astype(np.float32), np.concatenate(frames)
