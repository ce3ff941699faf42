"""Clouds with known trunks for the detector's tests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def ground(size_m: float = 4.0, step_m: float = 0.05, slope: float = 0.0) -> Floats:
    """A plane around the origin that rises along x."""
    g = np.arange(-size_m, size_m, step_m)
    x, y = (v.ravel() for v in np.meshgrid(g, g))
    return np.stack([x, y, slope * x], axis=1)


def trunk(
    x: float, y: float, radius: float, rng: np.random.Generator, *, height: float = 4.0, lean: tuple[float, float] = (0.0, 0.0),
    arc: tuple[float, float] = (-np.pi, np.pi), z: float = 0.0, low: float = 0.0, taper: float = 0.0, density: float = 2500.0,
) -> Floats:  # fmt: skip
    """Points on a leaning cylinder around (x, y); ``radius`` holds at 1.3 m. ``density`` is points per square metre."""
    n = int(density * radius * (arc[1] - arc[0]) * (height - low))
    a, h = rng.uniform(*arc, n), rng.uniform(low, height, n)
    r = radius + taper * (h - 1.3)
    return np.stack([x + lean[0] * h + r * np.cos(a), y + lean[1] * h + r * np.sin(a), z + h], axis=1)


def facing(x: float, y: float, eye: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float]:
    """The half of a trunk that an eye sees, as an arc."""
    towards = float(np.arctan2(eye[1] - y, eye[0] - x))
    return towards - 1.45, towards + 1.45


def with_depth_noise(points: Floats, eye: Floats, rng: np.random.Generator, k: float = 0.002) -> Floats:
    """Move points along their rays by noise that grows with the square of range."""
    ray = points - eye
    distance = np.linalg.norm(ray, axis=1, keepdims=True)
    noise = rng.normal(0.0, 1.0, (len(points), 1)) * k * distance**2
    return np.asarray(points + ray / distance * noise)


def bush(x: float, y: float, radius: float, height: float, rng: np.random.Generator, n: int = 4000) -> Floats:
    """Leaves in a ball."""
    p = rng.normal(0.0, 1.0, (n, 3))
    p *= rng.uniform(0.0, 1.0, (n, 1)) ** (1 / 3) / np.linalg.norm(p, axis=1, keepdims=True)
    return np.asarray(p * [radius, radius, height / 2] + [x, y, height / 2])


def wall(x: float, y0: float, y1: float, rng: np.random.Generator, height: float = 3.0, n: int = 8000) -> Floats:
    """An upright plane."""
    return np.stack(
        [np.full(n, x) + rng.normal(0, 0.004, n), rng.uniform(y0, y1, n), rng.uniform(0, height, n)], axis=1
    )
