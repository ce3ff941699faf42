"""From the points at trunk height to clusters of voxels per slice, by one hash table of small cells.

A cell is ``link`` wide in the plan and one slice high. Points go to cells, cells that touch become clusters, clusters
are put in order of height, and inside each cell the points become the centroids of 1 cm voxels: every step is a
counting sort or looks at one cell only, so that nothing of the size of the cloud is sorted or looked up twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.kernels import root_of, slot_of
from services.detector.band import Band
from services.detector.halves import both_halves
from services.detector.model import Floats, Ints, Views
from services.detector.upright import Upright

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]

_STRIDE = 2097152
_COLUMNS = (slice(0, 3), slice(3, 6), slice(6, 7), slice(7, 8))
_SAMPLES = 400
"""Voxels whose neighbours tell the spacing."""


@dataclass(frozen=True, slots=True)
class Voxels:
    """Centroids of occupied voxels in the upright frame, cluster after cluster, the lowest slice first."""

    xyz_m: Floats
    """(M, 3)."""
    height_m: Floats
    """(M,) above ground."""
    ray_m: Floats
    """(M, 3): mean vector from the camera centre to the point, zero where views are unknown."""
    count: Floats
    """(M,) points in the voxel."""
    seen_from: bool
    """Whether the rays are known."""


@dataclass(frozen=True, slots=True)
class Slices:
    """Voxels, and the clusters that they form in each slice."""

    voxels: Voxels
    begin: Ints
    """(C + 1,): cluster c holds the voxels begin[c] to begin[c + 1], all of one slice."""
    layer_m: float
    link_m: float
    spacing_m: float
    """Typical distance in the plan between neighbouring points of a slice."""


@njit(cache=True, nogil=True)
def _cells(
    xyz: Floats32, index: Ints32, low: Floats, layer_m: float, link: float, table: Ints32, keys: Ints, cell_of: Ints32
) -> int:
    """Give each point its cell, numbered in order of first appearance; return the number of cells."""
    m = 0
    per_link, per_layer = np.float32(1.0 / link), np.float32(1.0 / layer_m)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    last, last_cell = np.int64(-1), np.int32(0)
    for q in range(index.shape[0]):
        i = index[q]
        cx = np.int64((xyz[i, 0] - x0) * per_link) + 1
        cy = np.int64((xyz[i, 1] - y0) * per_link) + 1
        cl = np.int64((xyz[i, 2] - z0) * per_layer)
        key = (cl * np.int64(_STRIDE) + cx) * np.int64(_STRIDE) + cy
        if key != last:  # neighbours of an image mostly share a cell
            at = slot_of(table, keys, key)
            if table[at] < 0:
                table[at] = m
                keys[m] = key
                m += 1
            last, last_cell = key, table[at]
        cell_of[q] = last_cell
    return m


@njit(cache=True, nogil=True)
def _clusters(table: Ints32, keys: Ints, m: int, cluster_of: Ints) -> int:
    """Give each cell its cluster: touching cells (8 neighbours) of a slice, the lowest slice first; return their number."""
    parent = np.arange(m)
    stride = np.int64(_STRIDE)
    for a in range(m):
        for dx, dy in ((0, 1), (1, -1), (1, 0), (1, 1)):
            b = table[slot_of(table, keys, keys[a] + dx * stride + dy)]
            if b >= 0:
                ra, rb = root_of(parent, a), root_of(parent, b)
                if ra < rb:
                    parent[rb] = ra
                elif rb < ra:
                    parent[ra] = rb
    lowest, highest = np.int64(1 << 60), np.int64(-1)
    for a in range(m):
        level = keys[a] // (stride * stride)
        lowest, highest = min(lowest, level), max(highest, level)
    first = np.zeros(highest - lowest + 2, dtype=np.int64)
    for a in range(m):
        if root_of(parent, a) == a:
            first[keys[a] // (stride * stride) - lowest + 1] += 1
    for k in range(1, first.shape[0]):
        first[k] += first[k - 1]
    clusters = first[-1]
    for a in range(m):  # a root is the first of its cells, so its number is there before the others ask
        root = root_of(parent, a)
        if root == a:
            level = keys[a] // (stride * stride) - lowest
            cluster_of[a] = first[level]
            first[level] += 1
        else:
            cluster_of[a] = cluster_of[root]
    return clusters


@njit(cache=True, nogil=True)
def _ordered(label: NDArray[np.integer], groups: int) -> tuple[Ints, Ints]:
    """Return the items ordered by group and where each group begins (counting sort)."""
    begin = np.zeros(groups + 1, dtype=np.int64)
    for i in range(label.shape[0]):
        begin[label[i] + 1] += 1
    for c in range(groups):
        begin[c + 1] += begin[c]
    fill = begin[:-1].copy()
    order = np.empty(label.shape[0], dtype=np.int64)
    for i in range(label.shape[0]):
        order[fill[label[i]]] = i
        fill[label[i]] += 1
    return order, begin


@njit(cache=True, nogil=True)
def _centroids(
    xyz: Floats32, index: Ints32, height: Floats32, view: NDArray[np.int32], origins: Floats, order: Ints, begin: Ints,
    from_cell: int, to_cell: int, low: Floats, layer_m: float, link: float, voxel: float, out: Floats, ends: Ints,
) -> int:  # fmt: skip
    """Average the points of each cell per voxel: rows of x, y, z, ray (3), height, count; return the number of rows."""
    across, up = int(np.ceil(link / voxel)) + 1, int(np.ceil(layer_m / voxel)) + 1
    room = np.full(across * across * up, -1, dtype=np.int32)
    touched = np.empty(across * across * up, dtype=np.int32)
    m = 0
    with_views = view.shape[0] > 0
    per_voxel = 1.0 / voxel
    for c in range(from_cell, to_cell):
        used = 0
        head = index[order[begin[c]]]
        x0 = low[0] + np.floor((xyz[head, 0] - low[0]) / link) * link
        y0 = low[1] + np.floor((xyz[head, 1] - low[1]) / link) * link
        z0 = low[2] + np.floor((xyz[head, 2] - low[2]) / layer_m) * layer_m
        for q in range(begin[c], begin[c + 1]):
            k = order[q]
            i = index[k]
            a = min(max(int((xyz[i, 0] - x0) * per_voxel), 0), across - 1)
            b = min(max(int((xyz[i, 1] - y0) * per_voxel), 0), across - 1)
            l = min(max(int((xyz[i, 2] - z0) * per_voxel), 0), up - 1)  # noqa: E741 - a, b, l: voxel
            at = (a * across + b) * up + l
            v = room[at]
            if v < 0:
                v = m
                room[at] = v
                touched[used] = at
                used += 1
                m += 1
                out[v] = 0.0
            for d in range(3):
                out[v, d] += xyz[i, d]
            out[v, 6] += height[k]
            out[v, 7] += 1.0
            if with_views:
                o = view[i]
                for d in range(3):
                    out[v, 3 + d] += xyz[i, d] - origins[o, d]
        for u in range(used):
            room[touched[u]] = -1
        ends[c] = m
    for v in range(m):
        share = 1.0 / out[v, 7]
        for d in range(7):
            out[v, d] *= share
    return m


@njit(cache=True, nogil=True)
def _spacing(xyz: Floats, m: int, ends: Ints, rank: Ints, table: Ints32, keys: Ints, cell_order: Ints) -> float:
    """Return the median distance in the plan from a voxel to its nearest in the same or a touching cell (-1: too few).

    ``rank`` is each cell's place in the order of clusters, ``ends`` where each place's voxels end.
    """
    samples = np.empty(_SAMPLES + 1)
    step = max(1, m // _SAMPLES)
    taken, c, lonely = 0, 0, 0
    for i in range(0, m, step):
        while ends[c] <= i:
            c += 1
        key = keys[cell_order[c]]
        best = 1e30
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                cell = table[slot_of(table, keys, key + dx * np.int64(_STRIDE) + dy)]
                if cell < 0:
                    continue
                place = rank[cell]
                for j in range(ends[place - 1] if place > 0 else 0, ends[place]):
                    if j != i:
                        best = min(best, (xyz[i, 0] - xyz[j, 0]) ** 2 + (xyz[i, 1] - xyz[j, 1]) ** 2)
        if best > 1e29:
            lonely += 1
        elif taken < _SAMPLES:
            samples[taken] = np.sqrt(best)
            taken += 1
    return np.median(samples[:taken]) if taken > 2 * lonely else -1.0


def slice_clusters(
    frame: Upright, band: Band, views: Views | None, layer_m: float, link_m: float, voxel_m: float
) -> Slices:
    """Return the clusters of every slice; slices and links grow where the cloud is too sparse for those asked for."""
    found = _at_scale(frame, band, views, layer_m, link_m, voxel_m)
    spacing = found.spacing_m
    wide_link, wide_layer = _wider(spacing, layer_m, link_m)
    if wide_link <= link_m and wide_layer <= layer_m:
        return found
    found = _at_scale(frame, band, views, wide_layer, wide_link, voxel_m)
    return Slices(found.voxels, found.begin, wide_layer, wide_link, spacing)


def _wider(spacing_m: float, layer_m: float, link_m: float) -> tuple[float, float]:
    """Return the link and the slice that a spacing needs."""
    link = float(np.clip(2.5 * spacing_m, link_m, max(link_m, 0.08)))
    return link, float(np.clip(4.0 * spacing_m, layer_m, 2.5 * layer_m))


def _at_scale(frame: Upright, band: Band, views: Views | None, layer_m: float, link_m: float, voxel_m: float) -> Slices:
    n = len(band.index)
    table = np.full(1 << max(10, int(1.5 * n).bit_length()), -1, dtype=np.int32)
    keys, cell_of = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int32)
    m = int(_cells(frame.xyz_m, band.index, frame.low, layer_m, link_m, table, keys, cell_of))
    if m == 0:
        nothing = Voxels(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0), views is not None)
        return Slices(nothing, np.zeros(1, dtype=np.int64), layer_m, link_m, 0.0)
    cluster_of = np.empty(m, dtype=np.int64)
    clusters = int(_clusters(table, keys, m, cluster_of))
    cell_order, cell_begin = _ordered(cluster_of, clusters)
    rank = np.empty(m, dtype=np.int64)
    rank[cell_order] = np.arange(m)
    order, begin = _ordered(rank[cell_of], m)
    view = views.index if views is not None else np.empty(0, dtype=np.int32)
    origins = np.ascontiguousarray(frame.from_input(views.origins_m) if views is not None else np.empty((0, 3)))
    voxels, ends = _voxels(frame, band, (view, origins), order, begin, (layer_m, link_m, voxel_m))
    spacing = float(_spacing(voxels.xyz_m, len(voxels.xyz_m), ends, rank, table, keys, cell_order))
    starts = np.concatenate([[0], ends])[cell_begin].astype(np.int64)
    if spacing < 0.0:  # neighbours are further than a cell: look in a ring of wide cells
        spacing = _wide_spacing_m(voxels, frame.low, layer_m)
    return Slices(voxels, starts, layer_m, link_m, spacing)


def _voxels(
    frame: Upright, band: Band, seen: tuple[NDArray[np.int32], Floats], order: Ints, begin: Ints,
    sizes_m: tuple[float, float, float],
) -> tuple[Voxels, Ints]:  # fmt: skip
    """Return the voxels of all cells and where each cell's end; ``seen``: view index and upright origins."""
    m = len(begin) - 1
    middle = int(np.searchsorted(begin, begin[-1] // 2))
    outs: list[Floats] = [np.zeros((0, 8)), np.zeros((0, 8))]
    ends = np.empty(m, dtype=np.int64)

    def work(half: int) -> None:
        first, end = (0, middle) if half == 0 else (middle, m)
        out = np.empty((begin[end] - begin[first], 8))
        rows = _centroids(
            frame.xyz_m, band.index, band.height_m, *seen, order, begin, first, end, frame.low, *sizes_m, out, ends
        )  # fmt: skip
        outs[half] = out[: int(rows)]

    both_halves(work, 2 * len(order))
    ends[middle:] += len(outs[0])
    xyz, ray, height, count = (np.concatenate([out[:, columns] for out in outs]) for columns in _COLUMNS)
    return Voxels(xyz, height[:, 0].copy(), ray, count[:, 0].copy(), len(seen[0]) > 0), ends


def _wide_spacing_m(voxels: Voxels, low: Floats, layer_m: float) -> float:
    """Return the median distance in the plan to the nearest point of a slice, for sparse clouds."""
    from scipy.spatial import cKDTree

    P = voxels.xyz_m
    if len(P) < 3:
        return 0.0
    flat = np.column_stack([P[:, :2], 1e3 * np.floor((P[:, 2] - low[2]) / layer_m)])
    sample = flat[:: max(1, len(flat) // _SAMPLES)]
    distance = cKDTree(flat).query(sample, k=2, distance_upper_bound=0.5)[0][:, 1]
    near = distance[np.isfinite(distance)]
    return float(np.median(near)) if len(near) else 0.0
