"""The ground under the cloud: the lowest points of 0.5 m cells, made one robust plane per cell.

The lowest point of a cell keeps its own x and y, so that on a slope it is a point of the ground and no bias. Cells
that show only a trunk or a bush hang above their neighbours by more than a slope can explain and are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.detector import ground_kernels as kernels
from services.detector import ground_surface as surface
from services.detector.halves import both_halves, half_of
from services.detector.model import Floats, Ground
from services.detector.upright import Upright

Ints32 = NDArray[np.int32]

_MAX_CELLS = 2_000_000
_SAMPLE = 40_000
_SAMPLE_PER_CELL = 30
"""So many points tell where the surface lies in its cell."""


@dataclass(frozen=True, slots=True)
class GroundedCloud:
    """The ground, and in which of its cells each point is."""

    ground: Ground
    cell_of: Ints32
    """(N,): index of the cell, row by row; -1 where a point is none."""


def find_ground(frame: Upright, cell_m: float) -> GroundedCloud:
    """Return the ground under the points of an upright frame.

    Without anything ground-like (a cut-out trunk, heights already normalised) ``seen`` is false: heights are then
    above z = 0 where the cloud begins within 0..1.3 m of it, else above the lowest points.
    """
    x0, y0 = float(frame.low[0]), float(frame.low[1])
    size = frame.high[:2] - frame.low[:2]
    cell = cell_m
    while (size[0] / cell + 1) * (size[1] / cell + 1) > _MAX_CELLS:
        cell *= 2.0
    nx, ny = int(size[0] / cell) + 1, int(size[1] / cell) + 1
    cell_of, at, counts = _lows(frame, x0, y0, cell, nx, ny)
    cell_points, valid = np.zeros((nx, ny, 3)), np.zeros((nx, ny), dtype=np.bool_)
    kernels.choose_lows(frame.xyz_m, at, counts, cell_points, valid)
    kernels.drop_pits(cell_points, valid)
    kernels.drop_hanging(cell_points, valid, cell)
    planes = _planes(cell_points, valid, counts, (x0, y0, cell))
    lowest = Ground(x0, y0, cell, planes, seen=True, note="ground seen")
    bins, low, mid = _surface(frame, cell_of, lowest)
    if low > 1.5 * mid and low >= 50:
        surface.settle(bins, planes)
        return GroundedCloud(lowest, cell_of)
    return GroundedCloud(_without_ground(frame, lowest), cell_of)


def _lows(frame: Upright, x0: float, y0: float, cell: float, nx: int, ny: int) -> tuple[Ints32, Ints32, Ints32]:
    """Return each point's cell, and per cell the indices of its lowest points and the number of its points."""
    n = len(frame.xyz_m)
    cell_of = np.empty(n, dtype=np.int32)
    lows = np.full((2, nx * ny, kernels.KEEP), np.float32(1e30))
    at = np.zeros((2, nx * ny, kernels.KEEP), dtype=np.int32)
    counts = np.zeros((2, nx * ny), dtype=np.int32)

    def work(half: int) -> None:
        begin, end = half_of(n, half)
        kernels.cell_lows(frame.xyz_m, begin, end, x0, y0, cell, ny, cell_of, lows[half], at[half], counts[half])

    both_halves(work, n)
    kernels.merge_lows(lows[0], at[0], counts[0], lows[1], at[1], counts[1])
    return cell_of, at[0], counts[0]


def _planes(cell_points: Floats, valid: NDArray[np.bool_], counts: Ints32, grid: tuple[float, float, float]) -> Floats:
    """Return a plane per cell (nx, ny, 3), without the cells that stand above their wider surroundings."""
    nx, ny = valid.shape
    drop, planes = np.zeros((nx, ny), dtype=np.bool_), np.zeros((nx, ny, 3))
    many = 40 * nx * ny
    both_halves(lambda half: kernels.above_wide_plane(cell_points, valid, *grid, half, drop), many)
    valid &= ~drop
    both_halves(lambda half: kernels.fit_planes(cell_points, valid, counts, *grid, half, planes), many)
    return planes


def _surface(frame: Upright, cell_of: Ints32, ground: Ground) -> tuple[Ints32, int, int]:
    """Return the bins of heights near the planes, and the patches hit at the ground and above it."""
    nx, ny, _ = ground.planes.shape
    n = len(cell_of)
    step = max(1, n // max(_SAMPLE, _SAMPLE_PER_CELL * nx * ny))
    bins = np.zeros((2, nx, ny, surface.BINS), dtype=np.int32)
    hits = np.zeros((2, nx * 5, ny * 5), dtype=np.uint8)

    def work(half: int) -> None:
        begin, end = half_of(n, half)
        surface.near_surface(
            frame.xyz_m, cell_of, begin, end, step, ground.x0_m, ground.y0_m, ground.cell_m, ground.planes, bins[half], hits[half]
        )  # fmt: skip

    both_halves(work, n // step)
    low, mid = surface.count_patches(hits[0], hits[1])
    bins[0] += bins[1]
    return bins[0], int(low), int(mid)


def _without_ground(frame: Upright, lowest: Ground) -> Ground:
    zero = float((frame.R @ -frame.shift)[2])  # z of the input's origin in the upright frame
    if -0.2 <= frame.low[2] - zero <= 1.3:
        planes = np.zeros_like(lowest.planes)
        planes[..., 0] = zero
        note = "no ground in the cloud: heights are taken as above ground already"
        return replace(lowest, planes=planes, seen=False, note=note)
    note = "no ground in the cloud: heights are above the lowest points"
    return replace(lowest, seen=False, note=note)
