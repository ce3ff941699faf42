"""What a time-of-flight camera makes of a perfect depth image.

Noise along the optical axis after Fankhauser, Bloesch, Rodriguez, Kaestner, Hutter and Siegwart, "Kinect v2 for mobile
robot navigation: evaluation and modeling" (2015), indoors: ``1.5 - 0.5 z + 0.3 z^2 + 0.1 z^1.5 t^2 / (pi/2 - t)^2``
millimetres, z in metres, t the angle between the surface's normal and the optical axis. A pixel on an edge gets light from
both sides and lies between them.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.simulator.world import Floats32

WINDOW_PX = 3
_STEEPEST_RAD = 1.396
"""80 degrees: towards 90 the law has no bound."""
_EDGE_SHARE = 0.05


@njit(cache=True, nogil=True, error_model="numpy")
def dropout_quantile(share: float) -> float:
    """Return about the normal quantile of a small share: it stands far out in the field's tail."""
    return float(-np.sqrt(max(0.0, -2.0 * np.log(max(share, 1e-9) * 2.0))))


@njit(cache=True, nogil=True, error_model="numpy")
def axial_sigma_m(z: float, steepness: float) -> float:
    """Return the law's standard deviation for a surface with the slope ``steepness`` = tan t against the image plane."""
    t = min(np.arctan(steepness), _STEEPEST_RAD)
    return 1e-3 * (1.5 - 0.5 * z + 0.3 * z * z + 0.1 * z * np.sqrt(z) * (t / (0.5 * np.pi - t)) ** 2)


@njit(cache=True, nogil=True, error_model="numpy")
def measure(
    depth: Floats32, spread: Floats32, mixed: Floats32, noise: Floats32, holes: Floats32, focal_px: tuple[float, float],
    limits: tuple[float, float, float, float], out: NDArray[np.uint16],
) -> None:  # fmt: skip
    """Fill ``out`` (H, W) with millimetres.

    ``spread`` and ``mixed``: range and mean of the window around each pixel. ``noise`` and ``holes``: unit normal fields.
    ``limits``: nearest, where data begin to thin out, farthest, share of pixels without data.
    """
    height, width = depth.shape
    near, fade, far, dropout = limits
    tail = dropout_quantile(dropout)
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            limit = tail
            if spread[v, u] > _EDGE_SHARE * z and abs(mixed[v, u] - z) > 0.1 * spread[v, u]:
                z, limit = mixed[v, u], -0.4
            left, right = depth[v, max(u - 1, 0)], depth[v, min(u + 1, width - 1)]
            above, below = depth[max(v - 1, 0), u], depth[min(v + 1, height - 1), u]
            steepness = np.hypot((right - left) * focal_px[0], (below - above) * focal_px[1]) / (2.0 * depth[v, u])
            z += axial_sigma_m(z, steepness) * noise[v, u]
            if z < near or z > far:
                continue
            if z > fade:
                limit = max(limit, -2.0 + 4.0 * (z - fade) / (far - fade))
            if holes[v, u] >= limit:
                out[v, u] = np.uint16(z * 1000.0 + 0.5)
