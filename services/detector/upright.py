"""The upright frame: the input turned so that up is +z and moved so that numbers are small."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.geometry import rotation_aligning
from services.detector.halves import both_halves, half_of
from services.detector.model import Floats

Floats32 = NDArray[np.float32]

LIMIT_M = 1e9
"""Coordinates beyond this are no coordinates."""
_WIDEST_M = 3_000.0
"""A cloud wider than this has strays: what lies far from the bulk is left out."""


@dataclass(frozen=True, slots=True)
class Upright:
    """``p_upright = R (p - shift)``, and all points in that frame."""

    R: Floats
    shift: Floats
    low: Floats
    """Smallest upright coordinates of the finite points, (3,)."""
    high: Floats
    finite: int
    xyz_m: Floats32 = field(repr=False)
    """(N, 3): the points; x is NaN where a point is none."""

    def to_input(self, p: Floats) -> Floats:
        """Return points (..., 3) of the upright frame in the input frame."""
        return p @ self.R + self.shift

    def from_input(self, p: Floats) -> Floats:
        """Return points (..., 3) of the input frame in the upright frame."""
        return (p - self.shift) @ self.R.T


@njit(cache=True, nogil=True)
def _place(
    points: NDArray[np.floating], begin: int, end: int, R: Floats, shift: Floats, out: Floats32, low: Floats, high: Floats
) -> int:  # fmt: skip
    """Write upright points; widen the bounds by them; return how many are finite."""
    finite = 0
    r00, r01, r02 = R[0, 0], R[0, 1], R[0, 2]
    r10, r11, r12 = R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22 = R[2, 0], R[2, 1], R[2, 2]
    x0, y0, z0, x1, y1, z1 = low[0], low[1], low[2], high[0], high[1], high[2]
    for i in range(begin, end):
        px, py, pz = points[i, 0] - shift[0], points[i, 1] - shift[1], points[i, 2] - shift[2]
        if not (abs(px) < 1e9 and abs(py) < 1e9 and abs(pz) < 1e9):
            out[i, 0] = np.nan
            continue
        finite += 1
        x = np.float32(r00 * px + r01 * py + r02 * pz)
        y = np.float32(r10 * px + r11 * py + r12 * pz)
        z = np.float32(r20 * px + r21 * py + r22 * pz)
        out[i, 0], out[i, 1], out[i, 2] = x, y, z
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    low[0], low[1], low[2], high[0], high[1], high[2] = x0, y0, z0, x1, y1, z1
    return finite


def upright_frame(points_m: NDArray[np.floating], up: tuple[float, float, float]) -> Upright:
    """Return the upright frame of a cloud (N, 3); ``up`` need not be of unit length."""
    R = rotation_aligning(np.asarray(up, dtype=float), (0.0, 0.0, 1.0))
    shift = _near_point(points_m)
    n = len(points_m)
    xyz = np.empty((n, 3), dtype=np.float32)
    low, high, finite = np.full((2, 3), np.inf), np.full((2, 3), -np.inf), [0, 0]

    def place(half: int) -> None:
        finite[half] = int(_place(points_m, *half_of(n, half), R, shift, xyz, low[half], high[half]))

    both_halves(place, n)
    frame = Upright(R, shift, low.min(axis=0), high.max(axis=0), sum(finite), xyz)
    wide = frame.finite > 0 and float((frame.high - frame.low)[:2].max()) > _WIDEST_M
    return _without_strays(frame) if wide else frame


def _near_point(points_m: NDArray[np.floating]) -> Floats:
    """Return whole metres near some points of the cloud: the median of a few, so that no stray decides."""
    few = np.asarray(points_m[:: max(1, len(points_m) // 64)], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        few = few[(np.abs(few) < LIMIT_M).all(axis=1)]
    return np.floor(np.median(few, axis=0)) if len(few) else np.zeros(3)


def _without_strays(frame: Upright) -> Upright:
    """Leave out points far from the bulk: the grid over them would be too coarse for everything else."""
    xyz = frame.xyz_m
    sample = xyz[np.isfinite(xyz[:, 0])][:: max(1, frame.finite // 50_000)]
    near, far = np.percentile(sample, 0.5, axis=0), np.percentile(sample, 99.5, axis=0)
    margin = 0.5 * (far - near) + 20.0
    with np.errstate(invalid="ignore"):
        good = ((xyz >= near - margin) & (xyz <= far + margin)).all(axis=1)
    xyz[~good, 0] = np.nan
    kept = xyz[good]
    return Upright(
        frame.R, frame.shift, kept.min(axis=0).astype(np.float64), kept.max(axis=0).astype(np.float64), len(kept), xyz
    )
