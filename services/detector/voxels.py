"""From all points to the few that matter: crop by height above ground, centroids per voxel, clusters per slice."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.detector.model import Floats, Ground, Ints, Views
from services.detector.upright import Upright


@dataclass(frozen=True, slots=True)
class Voxels:
    """Centroids of occupied voxels in the upright frame."""

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


@njit(cache=True, nogil=True)
def _slot(table: Ints, keys: Ints, key: np.int64) -> np.int64:
    """Return the slot of ``key`` in an open-addressing table, or of the free place where it belongs."""
    mask = np.int64(table.shape[0] - 1)
    at = (key * np.int64(-7046029254386353131) >> 20) & mask
    while table[at] >= 0 and keys[table[at]] != key:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True)
def _crop(
    points: NDArray[np.floating], R: Floats, shift: Floats, x0: float, y0: float, cell: float, planes: Floats,
    low: float, high: float, chosen: Ints, local: Floats,
) -> int:  # fmt: skip
    """Write index and upright (x, y, z, height) of the points between two heights above ground; return their number."""
    nx, ny, _ = planes.shape
    n = 0
    for i in range(points.shape[0]):
        px = points[i, 0] - shift[0]
        py = points[i, 1] - shift[1]
        pz = points[i, 2] - shift[2]
        if not (abs(px) < 1e9 and abs(py) < 1e9 and abs(pz) < 1e9):
            continue
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        a = min(int((x - x0) / cell), nx - 1)
        b = min(int((y - y0) / cell), ny - 1)
        h = (
            z - planes[a, b, 0]
            - planes[a, b, 1] * (x - x0 - (a + 0.5) * cell)
            - planes[a, b, 2] * (y - y0 - (b + 0.5) * cell)
        )  # fmt: skip
        if low <= h <= high:
            chosen[n] = i
            local[n, 0] = x
            local[n, 1] = y
            local[n, 2] = z
            local[n, 3] = h
            n += 1
    return n


@njit(cache=True, nogil=True)
def _voxelise(
    local: Floats, chosen: Ints, n: int, voxel: float, low: Floats, index: NDArray[np.int32], origins: Floats,
    size: int, xyz: Floats, height: Floats, ray: Floats, count: Floats,
) -> int:  # fmt: skip
    """Sum points per voxel in order of first appearance, then divide; return the number of voxels."""
    table = np.full(size, -1, dtype=np.int64)
    keys = np.empty(n, dtype=np.int64)
    m = 0
    with_views = index.shape[0] > 0
    for i in range(n):
        kx = np.int64((local[i, 0] - low[0]) / voxel)
        ky = np.int64((local[i, 1] - low[1]) / voxel)
        kz = np.int64((local[i, 2] - low[2]) / voxel)
        key = (kx * np.int64(2097152) + ky) * np.int64(2097152) + kz
        at = _slot(table, keys, key)
        v = table[at]
        if v < 0:
            v = m
            table[at] = m
            keys[m] = key
            m += 1
        count[v] += 1.0
        height[v] += local[i, 3]
        for c in range(3):
            xyz[v, c] += local[i, c]
        if with_views:
            o = index[chosen[i]]
            for c in range(3):
                ray[v, c] += local[i, c] - origins[o, c]
    for v in range(m):
        height[v] /= count[v]
        for c in range(3):
            xyz[v, c] /= count[v]
            ray[v, c] /= count[v]
    return m


def crop_to_voxels(
    points_m: NDArray[np.floating], views: Views | None, frame: Upright, ground: Ground, low_m: float, high_m: float,
    voxel_m: float,
) -> Voxels:  # fmt: skip
    """Return one centroid per voxel of the points between two heights above ground."""
    n_all = len(points_m)
    chosen, local = np.empty(n_all, dtype=np.int64), np.empty((n_all, 4))
    n = int(
        _crop(points_m, frame.R, frame.shift, ground.x0_m, ground.y0_m, ground.cell_m, ground.planes, low_m, high_m, chosen, local)
    )  # fmt: skip
    index = views.index if views is not None else np.empty(0, dtype=np.int32)
    origins = frame.from_input(views.origins_m) if views is not None else np.empty((0, 3))
    size = 1 << max(10, int(2 * n).bit_length())
    xyz, height, ray, count = np.zeros((n, 3)), np.zeros(n), np.zeros((n, 3)), np.zeros(n)
    m = int(
        _voxelise(local, chosen, n, voxel_m, frame.low, index, np.ascontiguousarray(origins), size, xyz, height, ray, count)
    )  # fmt: skip
    return Voxels(xyz[:m], height[:m], ray[:m], count[:m], views is not None)


@njit(cache=True, nogil=True)
def _root(parent: Ints, a: int) -> int:
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(cache=True, nogil=True)
def _components(xyz: Floats, low: Floats, layer_m: float, link: float, size: int, label: Ints) -> int:
    """Label voxels by connected cells (8 neighbours) of their layer, in order of first appearance."""
    n = xyz.shape[0]
    table = np.full(size, -1, dtype=np.int64)
    keys = np.empty(n, dtype=np.int64)
    cell_of = np.empty(n, dtype=np.int64)
    m = 0
    stride = np.int64(2097152)
    for i in range(n):
        cx = np.int64((xyz[i, 0] - low[0]) / link) + 1
        cy = np.int64((xyz[i, 1] - low[1]) / link) + 1
        cl = np.int64((xyz[i, 2] - low[2]) / layer_m)
        key = (cl * stride + cx) * stride + cy
        at = _slot(table, keys, key)
        if table[at] < 0:
            table[at] = m
            keys[m] = key
            m += 1
        cell_of[i] = table[at]
    parent = np.arange(m)
    for a in range(m):
        for dx, dy in ((0, 1), (1, -1), (1, 0), (1, 1)):
            b = table[_slot(table, keys, keys[a] + dx * stride + dy)]
            if b >= 0:
                ra, rb = _root(parent, a), _root(parent, b)
                if ra < rb:
                    parent[rb] = ra
                elif rb < ra:
                    parent[ra] = rb
    name = np.full(m, -1, dtype=np.int64)
    clusters = 0
    for i in range(n):
        root = _root(parent, cell_of[i])
        if name[root] < 0:
            name[root] = clusters
            clusters += 1
        label[i] = name[root]
    return clusters


@njit(cache=True, nogil=True)
def _grouped(label: Ints, clusters: int) -> tuple[Ints, Ints]:
    """Return the voxels ordered by cluster and where each cluster begins (counting sort)."""
    begin = np.zeros(clusters + 1, dtype=np.int64)
    for i in range(label.shape[0]):
        begin[label[i] + 1] += 1
    for c in range(clusters):
        begin[c + 1] += begin[c]
    fill = begin[:-1].copy()
    order = np.empty(label.shape[0], dtype=np.int64)
    for i in range(label.shape[0]):
        order[fill[label[i]]] = i
        fill[label[i]] += 1
    return order, begin


def clusters_per_layer(voxels: Voxels, low: Floats, layer_m: float, link_m: float) -> tuple[Ints, Ints]:
    """Return (order, begin): cluster c holds the voxels ``order[begin[c]:begin[c + 1]]``, all of one layer."""
    n = len(voxels.xyz_m)
    label = np.empty(n, dtype=np.int64)
    size = 1 << max(10, int(2 * n).bit_length())
    clusters = int(_components(voxels.xyz_m, low, layer_m, link_m, size, label))
    order, begin = _grouped(label, clusters)
    return order, begin


@njit(cache=True, nogil=True)
def _spacing(xyz: Floats, low: Floats, layer_m: float, size: int) -> float:
    """Return the median distance in the plan between neighbours of one 10 cm cell (an estimate of point spacing)."""
    n = xyz.shape[0]
    cell = 0.1
    table = np.full(size, -1, dtype=np.int64)
    keys = np.empty(n, dtype=np.int64)
    head = np.full(n, -1, dtype=np.int64)
    following = np.full(n, -1, dtype=np.int64)
    m = 0
    stride = np.int64(2097152)
    for i in range(n):
        key = (np.int64((xyz[i, 2] - low[2]) / layer_m) * stride + np.int64((xyz[i, 0] - low[0]) / cell)) * stride
        key += np.int64((xyz[i, 1] - low[1]) / cell)
        at = _slot(table, keys, key)
        if table[at] < 0:
            table[at] = m
            keys[m] = key
            m += 1
        following[i] = head[table[at]]
        head[table[at]] = i
    samples = np.empty(2000)
    taken = 0
    step = max(1, n // 2000)
    for i in range(0, n, step):
        key = (np.int64((xyz[i, 2] - low[2]) / layer_m) * stride + np.int64((xyz[i, 0] - low[0]) / cell)) * stride
        key += np.int64((xyz[i, 1] - low[1]) / cell)
        j = head[table[_slot(table, keys, key)]]
        best = 1e30
        while j >= 0:
            if j != i:
                d = (xyz[i, 0] - xyz[j, 0]) ** 2 + (xyz[i, 1] - xyz[j, 1]) ** 2
                best = min(best, d)
            j = following[j]
        if best < 1e30 and taken < 2000:
            samples[taken] = np.sqrt(best)
            taken += 1
    return np.median(samples[:taken]) if taken > 0 else 0.0


def plan_spacing_m(voxels: Voxels, low: Floats, layer_m: float) -> float:
    """Return the typical distance between neighbouring points of a slice, metres (0 for an empty cloud)."""
    n = len(voxels.xyz_m)
    return float(_spacing(voxels.xyz_m, low, layer_m, 1 << max(10, int(2 * n).bit_length())))
