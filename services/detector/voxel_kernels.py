"""Kernels of the slices: points to cells, cells to clusters, clusters to voxels; one run of slices at a time.

Slices know nothing of each other, so that two threads can each take a run of them.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.kernels import root_of, slot_of
from services.detector.model import Floats, Ints

Floats32 = NDArray[np.float32]
Ints32 = NDArray[np.int32]

_STRIDE = 2097152
SAMPLES = 200
"""Voxels of a run whose neighbours tell the spacing."""


@njit(cache=True, nogil=True)
def count_levels(xyz: Floats32, z_low: float, layer_m: float, counts: Ints) -> None:
    """Count the points of each slice."""
    z0, per_layer = np.float32(z_low), np.float32(1.0 / layer_m)
    for i in range(xyz.shape[0]):
        counts[int((xyz[i, 2] - z0) * per_layer)] += 1


@njit(cache=True, nogil=True)
def _cells(
    xyz: Floats32, low: Floats, layer_m: float, link: float, from_level: int, to_level: int, table: Ints32, keys: Ints,
    index: Ints32, cell_of: Ints32,
) -> tuple[int, int]:  # fmt: skip
    """List the points of the run and give each its cell, numbered in order of first appearance; return both numbers."""
    n, m = 0, 0
    per_link, per_layer = np.float32(1.0 / link), np.float32(1.0 / layer_m)
    x0, y0, z0 = np.float32(low[0]), np.float32(low[1]), np.float32(low[2])
    last, last_cell = np.int64(-1), np.int32(0)
    for i in range(xyz.shape[0]):
        level = np.int64((xyz[i, 2] - z0) * per_layer)
        if level < from_level or level >= to_level:
            continue
        cx = np.int64((xyz[i, 0] - x0) * per_link) + 1
        cy = np.int64((xyz[i, 1] - y0) * per_link) + 1
        key = (level * np.int64(_STRIDE) + cx) * np.int64(_STRIDE) + cy
        if key != last:  # neighbours of an image mostly share a cell
            at = slot_of(table, keys, key)
            if table[at] < 0:
                table[at] = m
                keys[m] = key
                m += 1
            last, last_cell = key, table[at]
        index[n] = i
        cell_of[n] = last_cell
        n += 1
    return n, m


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
def _ordered(label: NDArray[np.integer], count: int, groups: int) -> tuple[Ints32, Ints32]:
    """Return the first ``count`` items ordered by group and where each group begins (counting sort)."""
    begin = np.zeros(groups + 1, dtype=np.int32)
    for i in range(count):
        begin[label[i] + 1] += 1
    for c in range(groups):
        begin[c + 1] += begin[c]
    fill = begin[:-1].copy()
    order = np.empty(count, dtype=np.int32)
    for i in range(count):
        order[fill[label[i]]] = i
        fill[label[i]] += 1
    return order, begin


@njit(cache=True, nogil=True)
def _centroids(
    xyz: Floats32, view: Ints32, index: Ints32, keys: Ints, cell_order: Ints32, order: Ints32, begin: Ints32, low: Floats,
    sizes: tuple[float, float, float], out: Floats32, seen_by: Ints32, ends: Ints32,
) -> int:  # fmt: skip
    """Average the points of each cell per voxel, the view is that of the first; return the number of voxels."""
    layer_m, link, voxel = sizes
    across, up = int(np.ceil(link / voxel)) + 1, int(np.ceil(layer_m / voxel)) + 1
    room = np.full(across * across * up, -1, dtype=np.int32)
    touched = np.empty(across * across * up, dtype=np.int32)
    count = np.empty(across * across * up, dtype=np.float32)
    with_views = view.shape[0] > 0
    per_voxel, stride = np.float32(1.0 / voxel), np.int64(_STRIDE)
    m = 0
    for c in range(begin.shape[0] - 1):
        used, base = 0, m
        key = keys[cell_order[c]]
        x0 = np.float32(low[0] + (((key // stride) % stride) - 1) * link)
        y0 = np.float32(low[1] + ((key % stride) - 1) * link)
        z0 = np.float32(low[2] + (key // (stride * stride)) * layer_m)
        for q in range(begin[c], begin[c + 1]):
            i = index[order[q]]
            x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            a = min(max(int((x - x0) * per_voxel), 0), across - 1)
            b = min(max(int((y - y0) * per_voxel), 0), across - 1)
            l = min(max(int((z - z0) * per_voxel), 0), up - 1)  # noqa: E741 - a, b, l: voxel
            at = (a * across + b) * up + l
            v = room[at]
            if v < 0:
                room[at] = m
                touched[used] = at
                count[used] = 1.0
                out[m, 0], out[m, 1], out[m, 2] = x, y, z
                if with_views:
                    seen_by[m] = view[i]
                used += 1
                m += 1
            else:
                count[v - base] += 1.0
                out[v, 0] += x
                out[v, 1] += y
                out[v, 2] += z
        for u in range(used):
            room[touched[u]] = -1
            share = np.float32(1.0) / count[u]
            for d in range(3):
                out[base + u, d] *= share
        ends[c + 1] = m
    return m


@njit(cache=True, nogil=True)
def _spacings(
    xyz: Floats32, m: int, ends: Ints32, rank: Ints32, table: Ints32, keys: Ints, cell_order: Ints32, out: Floats
) -> tuple[int, int]:
    """Write the distance in the plan from some voxels to their nearest in the same or a touching cell.

    ``rank`` is each cell's place in the order of clusters, ``ends`` where each place's voxels end. Returns how many were
    written, and how many have none so near.
    """
    step = max(1, m // SAMPLES)
    taken, c, lonely = 0, 0, 0
    for i in range(0, m, step):
        while ends[c + 1] <= i:
            c += 1
        key = keys[cell_order[c]]
        best = 1e30
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                cell = table[slot_of(table, keys, key + dx * np.int64(_STRIDE) + dy)]
                if cell < 0:
                    continue
                place = rank[cell]
                for j in range(ends[place], ends[place + 1]):
                    if j != i:
                        best = min(best, (xyz[i, 0] - xyz[j, 0]) ** 2 + (xyz[i, 1] - xyz[j, 1]) ** 2)
        if best > 1e29:
            lonely += 1
        elif taken < out.shape[0]:
            out[taken] = np.sqrt(best)
            taken += 1
    return taken, lonely


@njit(cache=True, nogil=True)
def slice_run(
    xyz: Floats32, view: Ints32, low: Floats, sizes: tuple[float, float, float], from_level: int, to_level: int, count: int,
    out: Floats32, seen_by: Ints32, spacing: Floats,
) -> tuple[Ints, int, int]:  # fmt: skip
    """Make clusters of voxels of the ``count`` points in some slices.

    ``sizes``: slice, link and voxel in metres. Writes voxels and their views (``out``, ``seen_by``) and samples of the
    spacing; returns where each cluster begins (and the last ends), and the numbers of samples and of voxels without near one.
    """
    size = 1024
    while size < 2 * count:
        size *= 2
    table = np.full(size, -1, dtype=np.int32)
    keys = np.empty(count, dtype=np.int64)
    index, cell_of = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int32)
    n, m = _cells(xyz, low, sizes[0], sizes[1], from_level, to_level, table, keys, index, cell_of)
    if m == 0:
        return np.zeros(1, dtype=np.int64), 0, 0
    cluster_of = np.empty(m, dtype=np.int64)
    clusters = _clusters(table, keys, m, cluster_of)
    cell_order, cell_begin = _ordered(cluster_of, m, clusters)
    rank = np.empty(m, dtype=np.int32)
    for k in range(m):
        rank[cell_order[k]] = k
    for q in range(n):
        cell_of[q] = rank[cell_of[q]]
    order, begin = _ordered(cell_of, n, m)
    ends = np.zeros(m + 1, dtype=np.int32)
    voxels = _centroids(xyz, view, index, keys, cell_order, order, begin, low, sizes, out, seen_by, ends)
    taken, lonely = _spacings(out, voxels, ends, rank, table, keys, cell_order, spacing)
    starts = np.empty(clusters + 1, dtype=np.int64)
    for c in range(clusters + 1):
        starts[c] = ends[cell_begin[c]]
    return starts, taken, lonely
