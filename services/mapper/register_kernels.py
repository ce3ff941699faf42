"""Kernels of registration: reduced depth, normals, and the normal equations of projective point-to-plane ICP."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Floats32 = NDArray[np.float32]


@njit(cache=True, nogil=True)
def reduce(depth: Floats32, rays: Floats32, block: int, slope: float, out: Floats32) -> None:
    """Fill each coarse pixel with the ray of its block's centre at the block's median depth, where depth agrees."""
    h, w, _ = out.shape
    values = np.empty(block * block, dtype=np.float32)
    for v in range(h):
        for u in range(w):
            n = 0
            for b in range(v * block, v * block + block):
                for a in range(u * block, u * block + block):
                    z = depth[b, a]
                    if z > 0.0:
                        values[n] = z
                        n += 1
            out[v, u, 2] = 0.0
            if 2 * n < block * block:
                continue
            part = np.sort(values[:n])
            z = part[n // 2]
            if part[(3 * n) // 4] - part[n // 4] > 4.0 * slope * z * z + 0.03:
                continue
            b, a = v * block + block // 2, u * block + block // 2
            x = 0.25 * (rays[b, a, 0] + rays[b - 1, a, 0] + rays[b, a - 1, 0] + rays[b - 1, a - 1, 0])
            y = 0.25 * (rays[b, a, 1] + rays[b - 1, a, 1] + rays[b, a - 1, 1] + rays[b - 1, a - 1, 1])
            if np.isnan(x) or np.isnan(y):
                continue
            out[v, u, 0] = x * z
            out[v, u, 1] = y * z
            out[v, u, 2] = z


@njit(cache=True, nogil=True)
def normals(points: Floats32, slope: float, out: Floats32) -> None:
    """Fit a plane z = a + b dx + c dy to the 5 x 5 neighbours near in depth; normals look at the camera."""
    h, w, _ = points.shape
    out[:] = 0.0
    for v in range(2, h - 2):
        for u in range(2, w - 2):
            z0 = points[v, u, 2]
            if z0 <= 0.0:
                continue
            reach = 0.06 + 4.0 * slope * z0 * z0
            n = 0
            sx, sy, sz, sxx, sxy, syy, sxz, syz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for j in range(-2, 3):
                for i in range(-2, 3):
                    z = points[v + j, u + i, 2]
                    if z <= 0.0 or abs(z - z0) > reach:
                        continue
                    x = points[v + j, u + i, 0] - points[v, u, 0]
                    y = points[v + j, u + i, 1] - points[v, u, 1]
                    d = z - z0
                    n += 1
                    sx += x
                    sy += y
                    sz += d
                    sxx += x * x
                    sxy += x * y
                    syy += y * y
                    sxz += x * d
                    syz += y * d
            if n < 12:
                continue
            sxx -= sx * sx / n
            sxy -= sx * sy / n
            syy -= sy * sy / n
            sxz -= sx * sz / n
            syz -= sy * sz / n
            det = sxx * syy - sxy * sxy
            if det < 1e-12:
                continue
            b = (sxz * syy - syz * sxy) / det
            c = (syz * sxx - sxz * sxy) / det
            norm = np.sqrt(b * b + c * c + 1.0)
            out[v, u, 0] = b / norm
            out[v, u, 1] = c / norm
            out[v, u, 2] = -1.0 / norm


@njit(cache=True, nogil=True)
def accumulate(
    points: Floats32, T_ref_source: Matrix, R_map_ref: Matrix, t_map_ref: Matrix, centre: Matrix, ref_points: Floats32,
    ref_normals: Floats32, fx: float, fy: float, cx: float, cy: float, slope: float, bark: float, tukey: float,
    parity: int, A: Matrix, g: Matrix,
) -> tuple[float, int]:  # fmt: skip
    """Add the normal equations of every second pixel (checkerboard ``parity``); return the robust cost and the pairs.

    The perturbation is a left one in the map frame, rotation about ``centre``.
    """
    h, w, _ = points.shape
    J = np.empty(6)
    cost, pairs = 0.0, 0
    for v in range(h):
        for u in range(w):
            z = points[v, u, 2]
            if z <= 0.0 or (u + v) % 2 != parity:
                continue
            px, py = points[v, u, 0], points[v, u, 1]
            x = T_ref_source[0, 0] * px + T_ref_source[0, 1] * py + T_ref_source[0, 2] * z + T_ref_source[0, 3]
            y = T_ref_source[1, 0] * px + T_ref_source[1, 1] * py + T_ref_source[1, 2] * z + T_ref_source[1, 3]
            d = T_ref_source[2, 0] * px + T_ref_source[2, 1] * py + T_ref_source[2, 2] * z + T_ref_source[2, 3]
            if d < 0.3:
                continue
            a, b = int(np.floor(fx * x / d + cx + 0.5)), int(np.floor(fy * y / d + cy + 0.5))
            if not (0 <= a < w and 0 <= b < h):
                continue
            q, n = ref_points[b, a], ref_normals[b, a]
            if q[2] <= 0.0 or n[2] == 0.0:
                continue
            ref_range = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
            incidence = abs(n[0] * q[0] + n[1] * q[1] + n[2] * q[2]) / ref_range
            if incidence < 0.2:
                continue
            e = n[0] * (x - q[0]) + n[1] * (y - q[1]) + n[2] * (d - q[2])
            # block medians take out half of the noise; what is left is mostly the sensor's fixed pattern
            along = 0.5 * slope * incidence
            sigma2 = bark * bark + along * along * (q[2] ** 4 + z**4)
            s = e * e / sigma2 / (tukey * tukey)
            pairs += 1
            if s >= 1.0:
                cost += 1.0
                continue
            weight = (1.0 - s) ** 2
            cost += 1.0 - (1.0 - s) ** 3
            weight /= sigma2
            mx = R_map_ref[0, 0] * n[0] + R_map_ref[0, 1] * n[1] + R_map_ref[0, 2] * n[2]
            my = R_map_ref[1, 0] * n[0] + R_map_ref[1, 1] * n[1] + R_map_ref[1, 2] * n[2]
            mz = R_map_ref[2, 0] * n[0] + R_map_ref[2, 1] * n[1] + R_map_ref[2, 2] * n[2]
            lx = R_map_ref[0, 0] * x + R_map_ref[0, 1] * y + R_map_ref[0, 2] * d + t_map_ref[0] - centre[0]
            ly = R_map_ref[1, 0] * x + R_map_ref[1, 1] * y + R_map_ref[1, 2] * d + t_map_ref[1] - centre[1]
            lz = R_map_ref[2, 0] * x + R_map_ref[2, 1] * y + R_map_ref[2, 2] * d + t_map_ref[2] - centre[2]
            J[0], J[1], J[2] = mx, my, mz
            J[3] = ly * mz - lz * my
            J[4] = lz * mx - lx * mz
            J[5] = lx * my - ly * mx
            for r in range(6):
                g[r] += weight * J[r] * e
                for c in range(6):
                    A[r, c] += weight * J[r] * J[c]
    return cost, pairs
