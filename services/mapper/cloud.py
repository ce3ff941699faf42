"""One keyframe's depth image becomes points: pass-through, edges, outliers, voxel grid. Camera frame throughout."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.mapper.config import MapperConfig

Floats32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class KeyframeCloud:
    """Points of one keyframe in its camera frame; the camera's centre is their view origin."""

    points_m: Floats32 = field(repr=False)
    """(N, 3)."""
    rgb: NDArray[np.uint8] = field(repr=False)
    """(N, 3), zero where the keyframe had no colour."""


def pixel_rays(intrinsics: Intrinsics) -> Floats32:
    """Return (H, W, 2): x/z and y/z of each pixel's ray, lens distortion removed; NaN where there is none."""
    i = intrinsics
    u, v = np.meshgrid(np.arange(i.width, dtype=np.float64), np.arange(i.height, dtype=np.float64))
    if not i.distorted:
        return np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy], axis=2).astype(np.float32)
    import cv2

    K = np.array([[i.fx, 0.0, i.cx], [0.0, i.fy, i.cy], [0.0, 0.0, 1.0]])
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).reshape(-1, 1, 2)
    distortion = np.array([i.k1, i.k2, i.p1, i.p2, i.k3])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-7)
    rays = cv2.undistortPoints(pixels, K, distortion, criteria=criteria).reshape(-1, 2)
    again, _ = cv2.projectPoints(np.hstack([rays, np.ones((len(rays), 1))]), np.zeros(3), np.zeros(3), K, distortion)
    # far corners may lie where the model folds over: no ray leads there
    rays[np.abs(again.reshape(-1, 2) - pixels.reshape(-1, 2)).max(axis=1) > 0.2] = np.nan
    return np.asarray(rays, dtype=np.float32).reshape(i.height, i.width, 2)


@njit(cache=True, nogil=True)
def _without_edges(
    depth: Floats32, rays: Floats32, near: float, far: float, floor: float, slope: float, out: Floats32
) -> None:
    """Copy depth in range that is not on a ramp between a nearer and a farther surface.

    A pixel mixed from both sides of an edge has a step on each side (within two pixels), one up and one down; the last
    pixel of a surface has one on one side only and stays.
    """
    height, width = depth.shape
    for v in range(height):
        for u in range(width):
            out[v, u] = 0.0
            z = depth[v, u]
            if not near <= z <= far or np.isnan(rays[v, u, 0]):
                continue
            limit = floor + slope * z * z
            mixed = False
            for du, dv in ((1, 0), (0, 1), (2, 0), (0, 2)):
                a, b = 0.0, 0.0
                if u - du >= 0 and v - dv >= 0:
                    a = depth[v - dv, u - du]
                if u + du < width and v + dv < height:
                    b = depth[v + dv, u + du]
                if a <= 0.0 or b <= 0.0:
                    continue
                span = limit * 0.5 * (du + dv + 1)
                if (z - a > span and b - z > span) or (a - z > span and z - b > span):
                    mixed = True
                    break
            if not mixed:
                out[v, u] = z


@njit(cache=True, nogil=True)
def _loneliness(depth: Floats32, rays: Floats32, slope: float, pitch: float, out: Floats32) -> tuple[float, float]:
    """Fill each pixel's mean distance to its (up to) four nearest of the 8 neighbours two pixels away; return mean and deviation.

    Distances are shares of what pixel pitch and noise lead one to expect, so that near and far compare.
    """
    height, width = depth.shape
    near = np.empty(8)
    total, squares, n = 0.0, 0.0, 0
    for v in range(height):
        for u in range(width):
            out[v, u] = -1.0
            z = depth[v, u]
            if z <= 0.0:
                continue
            k = 0
            for dv in (-2, 0, 2):
                for du in (-2, 0, 2):
                    a, b = v + dv, u + du
                    if (du == 0 and dv == 0) or not (0 <= a < height and 0 <= b < width) or depth[a, b] <= 0.0:
                        continue
                    zn = depth[a, b]
                    dx = rays[a, b, 0] * zn - rays[v, u, 0] * z
                    dy = rays[a, b, 1] * zn - rays[v, u, 1] * z
                    d = np.sqrt(dx * dx + dy * dy + (zn - z) ** 2)
                    at = k
                    while at > 0 and near[at - 1] > d:
                        near[at] = near[at - 1]
                        at -= 1
                    near[at] = d
                    k += 1
            if k < 3:
                out[v, u] = np.inf
                continue
            share = np.mean(near[: min(k, 4)]) / (2.0 * pitch * z + slope * z * z)
            out[v, u] = share
            if share < 20.0:
                total += share
                squares += share * share
                n += 1
    mean = total / max(n, 1)
    return mean, np.sqrt(max(squares / max(n, 1) - mean * mean, 0.0))


@njit(cache=True, nogil=True)
def _voxel_grid(
    depth: Floats32, lonely: Floats32, limit: float, rays: Floats32, rgb: NDArray[np.uint8], voxel: float, size: int,
    points: NDArray[np.float64], colours: NDArray[np.float64], counts: NDArray[np.float64],
) -> int:  # fmt: skip
    """Sum points and colours per voxel in order of first appearance; return the number of voxels."""
    height, width = depth.shape
    table = np.full(size, -1, dtype=np.int64)
    keys = np.empty(points.shape[0], dtype=np.int64)
    mask = size - 1
    m = 0
    for v in range(height):
        for u in range(width):
            z = depth[v, u]
            if z <= 0.0 or not lonely[v, u] <= limit:
                continue
            x, y = rays[v, u, 0] * z, rays[v, u, 1] * z
            kx = np.int64(np.floor(x / voxel)) + 1048576
            ky = np.int64(np.floor(y / voxel)) + 1048576
            kz = np.int64(np.floor(z / voxel))
            key = (kx * np.int64(2097152) + ky) * np.int64(2097152) + kz
            h = key * np.int64(-7046029254386353131)
            at = (h ^ (h >> 32)) & mask
            while table[at] >= 0 and keys[table[at]] != key:
                at = (at + 1) & mask
            i = table[at]
            if i < 0:
                i = m
                table[at] = m
                keys[m] = key
                m += 1
            counts[i] += 1.0
            points[i, 0] += x
            points[i, 1] += y
            points[i, 2] += z
            for c in range(3):
                colours[i, c] += rgb[v, u, c]
    for i in range(m):
        for c in range(3):
            points[i, c] /= counts[i]
            colours[i, c] /= counts[i]
    return m


def keyframe_cloud(
    depth_m: Floats32, rgb: NDArray[np.uint8] | None, rays: Floats32, config: MapperConfig
) -> KeyframeCloud:
    """Return the filtered points of one depth image.

    Args:
        depth_m: (H, W) metres, 0 where there is no data.
        rgb: (H, W, 3) or None.
        rays: of ``pixel_rays`` for the same size.
        config: ranges, noise and leaf.
    """
    slope = config.range_noise_per_m
    clean, lonely = np.empty_like(depth_m), np.empty_like(depth_m)
    _without_edges(
        depth_m, rays, config.min_range_m, config.max_range_m, config.edge_floor_m, config.edge_sigmas * slope, clean
    )
    row, column = rays.shape[0] // 2, rays.shape[1] // 2
    pitch = float(abs(rays[row, column, 0] - rays[row, column - 1, 0]))
    mean, deviation = _loneliness(clean, rays, slope, pitch, lonely)
    limit = float(max(mean + config.outlier_sigmas * deviation, 2.0 * mean))  # the image's rim has fewer neighbours
    n = int(np.count_nonzero(clean))
    points, colours, counts = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n)
    colour = rgb if rgb is not None else np.zeros((*depth_m.shape, 3), dtype=np.uint8)
    size = 1 << max(10, int(2 * n).bit_length())
    m = int(_voxel_grid(clean, lonely, limit, rays, colour, config.voxel_m, size, points, colours, counts))
    return KeyframeCloud(points[:m].astype(np.float32), np.round(colours[:m]).astype(np.uint8))
