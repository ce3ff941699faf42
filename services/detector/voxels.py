"""From the points at trunk height to clusters of voxels per slice, by one hash table of small cells.

A cell is ``link`` wide in the plan and one slice high. Points go to cells, cells that touch become clusters, clusters
are put in order of height, and inside each cell the points become the centroids of 1 cm voxels: every step is a
counting sort or looks at one cell only, so that nothing of the size of the cloud is sorted or looked up twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.detector.band import Band
from services.detector.halves import both_halves
from services.detector.model import Floats, Ints, Views
from services.detector.upright import Upright
from services.detector.voxel_kernels import SAMPLES, count_levels, slice_run

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Voxels:
    """Centroids of occupied voxels in the upright frame, cluster after cluster, the lowest slice first."""

    xyz_m: Floats32
    """(M, 3)."""
    view: Ints32
    """(M,) row of ``origins_m``; empty where views are unknown."""
    origins_m: Floats
    """(V, 3) camera centres."""

    @property
    def seen_from(self) -> bool:
        """Whether it is known from where each voxel was seen."""
        return len(self.origins_m) > 0


@dataclass(frozen=True, slots=True)
class Slices:
    """Voxels, and the clusters that they form in each slice."""

    voxels: Voxels
    begin: Ints
    """(C + 1,): cluster c holds the voxels begin[c] to begin[c + 1], all of one slice."""
    split: int
    """The first cluster of the upper half of the slices."""
    layer_m: float
    link_m: float
    spacing_m: float
    """Typical distance in the plan between neighbouring points of a slice."""


def slice_clusters(
    frame: Upright, band: Band, views: Views | None, layer_m: float, link_m: float, voxel_m: float
) -> Slices:
    """Return the clusters of every slice; slices and links grow where the cloud is too sparse for those asked for."""
    origins = np.ascontiguousarray(frame.from_input(views.origins_m)) if views is not None else np.empty((0, 3))
    found = _at_scale(frame.low, band, origins, (layer_m, link_m, voxel_m))
    spacing = found.spacing_m
    wide_link, wide_layer = _wider(spacing, layer_m, link_m)
    if wide_link <= link_m and wide_layer <= layer_m:
        return found
    found = _at_scale(frame.low, band, origins, (wide_layer, wide_link, voxel_m))
    return Slices(found.voxels, found.begin, found.split, wide_layer, wide_link, spacing)


def _wider(spacing_m: float, layer_m: float, link_m: float) -> tuple[float, float]:
    """Return the link and the slice that a spacing needs."""
    link = float(np.clip(2.5 * spacing_m, link_m, max(link_m, 0.08)))
    return link, float(np.clip(4.0 * spacing_m, layer_m, 2.5 * layer_m))


def _at_scale(low: Floats, band: Band, origins: Floats, sizes_m: tuple[float, float, float]) -> Slices:
    """Return the slices of one scale; ``sizes_m``: slice, link, voxel. Each half of the slices has a thread."""
    n = len(band.xyz_m)
    top = float(band.xyz_m[:, 2].max()) if n else float(low[2])
    counts = np.zeros(int((top - low[2]) / sizes_m[0]) + 3, dtype=np.int64)
    count_levels(band.xyz_m, float(low[2]), sizes_m[0], counts)
    upto = np.cumsum(counts)
    level = int(np.searchsorted(upto, n // 2)) + 1
    middle = int(upto[min(level, len(upto)) - 1])
    xyz, view = np.empty((n, 3), dtype=np.float32), np.empty(len(band.view), dtype=np.int32)
    spacings = np.empty((2, SAMPLES + 2))
    runs = ((0, level, 0, middle), (level, len(counts) + 1, middle, n))
    starts: list[Ints] = [np.zeros(1, dtype=np.int64)] * 2
    sampled = [(0, 0), (0, 0)]

    def work(half: int) -> None:
        first, beyond, begin, end = runs[half]
        starts[half], *told = slice_run(
            band.xyz_m, band.view, low, sizes_m, first, beyond, end - begin, xyz[begin:end], view[begin:end], spacings[half]
        )  # fmt: skip
        sampled[half] = (int(told[0]), int(told[1]))

    both_halves(work, n)
    lower, upper = int(starts[0][-1]), int(starts[1][-1])
    for rows in (xyz, view) if len(view) else (xyz,):  # close the gap that averaging left between the halves
        rows[lower : lower + upper] = rows[middle : middle + upper]
    begin = np.concatenate([starts[0], starts[1][1:] + lower])
    voxels = Voxels(xyz[: lower + upper], view[: lower + upper], origins)
    spacing = _spacing_m(np.concatenate([spacings[k, : sampled[k][0]] for k in (0, 1)]), sampled[0][1] + sampled[1][1])
    if spacing < 0.0:  # neighbours are further than a cell: look in a ring of wide cells
        spacing = _wide_spacing_m(voxels, low, sizes_m[0])
    return Slices(voxels, begin, len(starts[0]) - 1, sizes_m[0], sizes_m[1], spacing)


def _spacing_m(samples: Floats, lonely: int) -> float:
    """Return the median of the samples, -1 where many voxels had no neighbour to give one."""
    return float(np.median(samples)) if len(samples) > 2 * lonely else (0.0 if lonely == 0 else -1.0)


def _wide_spacing_m(voxels: Voxels, low: Floats, layer_m: float) -> float:
    """Return the median distance in the plan to the nearest point of a slice, for sparse clouds."""
    from scipy.spatial import cKDTree

    P = voxels.xyz_m.astype(np.float64)
    if len(P) < 3:
        return 0.0
    flat = np.column_stack([P[:, :2], 1e3 * np.floor((P[:, 2] - low[2]) / layer_m)])
    sample = flat[:: max(1, len(flat) // (2 * SAMPLES))]
    distance = cKDTree(flat).query(sample, k=2, distance_upper_bound=0.5)[0][:, 1]
    near = distance[np.isfinite(distance)]
    return float(np.median(near)) if len(near) else 0.0
