"""Which voxels of the map are taken, by how many points, and seen from how near. A hash table with linear probing.

Points enter only where their voxel is not full yet, so that looking again at the same place costs no memory; a voxel
also takes what was seen from clearly nearer, because depth noise grows with the square of range. What leaves the map,
or moves within it, gives its voxels back.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.mapper.config import MapperConfig

Matrix = NDArray[np.float64]
Keys = NDArray[np.int64]

_START_SLOTS = 1 << 16


@njit(cache=True, nogil=True)
def _slot(key: np.int64, table_keys: Keys) -> int:
    mask = table_keys.shape[0] - 1
    h = key * np.int64(
        -7046029254386353131
    )  # Fibonacci hashing (Knuth, TAOCP 3, 6.4): the upper bits are the mixed ones
    at = (h ^ (h >> 32)) & mask
    while table_keys[at] != -1 and table_keys[at] != key:
        at = (at + 1) & mask
    return int(at)


@njit(cache=True, nogil=True)
def _key(x: float, y: float, z: float, voxel: float, level: np.int64) -> np.int64:
    key = np.int64(np.floor(x / voxel)) + 1048576
    key = key * np.int64(2097152) + np.int64(np.floor(y / voxel)) + 1048576
    return key * np.int64(2097152) + 2 * (np.int64(np.floor(z / voxel)) + 524288) + level


@njit(cache=True, nogil=True)
def _known_along(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, steps: int, voxel: float, level: np.int64,
    farthest: float, table_keys: Keys, table_count: NDArray[np.uint8], table_range: NDArray[np.float32],
) -> bool:  # fmt: skip
    """Tell whether a voxel within so many steps along the ray holds a point seen from nearer than ``farthest``."""
    for step in range(1, steps + 1):
        for f in (-float(step), float(step)):
            key = _key(x + f * dx, y + f * dy, z + f * dz, voxel, level)
            at = _slot(key, table_keys)
            if table_keys[at] == key and table_count[at] > 0 and table_range[at] <= farthest:
                return True
    return False


@njit(cache=True, nogil=True)
def _admit(
    points: NDArray[np.float32], T: Matrix, lows: NDArray[np.float32], cell: float, fine_low: float, fine_high: float,
    fine: float, coarse: float, per_voxel: int, nearer: float, table_keys: Keys, table_count: NDArray[np.uint8],
    table_range: NDArray[np.float32], shell: float, keep: NDArray[np.bool_], keys: Keys,
) -> int:  # fmt: skip
    """Enter points; mark those that their voxel takes and name each one's voxel. Return the number of new slots.

    With ``shell`` above zero a point is known already when a voxel is taken within ``shell r^2`` along its ray.
    """
    half = lows.shape[0] // 2
    fresh = 0
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        a = min(max(int(np.floor(x / cell)) + half, 0), 2 * half - 1)
        b = min(max(int(np.floor(y / cell)) + half, 0), 2 * half - 1)
        voxel, level = coarse, np.int64(1)
        if fine_low <= z - lows[a, b] <= fine_high:
            voxel, level = fine, np.int64(0)
        key = _key(x, y, z, voxel, level)
        keys[i] = key
        at = _slot(key, table_keys)
        r = np.sqrt(px * px + py * py + pz * pz)
        if shell > 0.0 and table_count[at] == 0:
            s = voxel / max(r, 0.1)
            dx, dy, dz = s * (x - T[0, 3]), s * (y - T[1, 3]), s * (z - T[2, 3])
            steps = int(shell * r * r / voxel)
            if _known_along(x, y, z, dx, dy, dz, steps, voxel, level, r / nearer, table_keys, table_count, table_range):
                keep[i] = False
                continue
        if table_keys[at] == -1:
            table_keys[at] = key
            fresh += 1
        if table_count[at] == 0:
            table_count[at] = 1
            table_range[at] = r
            keep[i] = True
        elif table_count[at] < per_voxel or r < nearer * table_range[at]:
            table_count[at] = min(255, table_count[at] + 1)
            table_range[at] = min(table_range[at], r)
            keep[i] = True
        else:
            keep[i] = False
    return fresh


@njit(cache=True, nogil=True)
def _release(keys: Keys, table_keys: Keys, table_count: NDArray[np.uint8]) -> None:
    for i in range(keys.shape[0]):
        at = _slot(keys[i], table_keys)
        if table_keys[at] == keys[i] and table_count[at] > 0:
            table_count[at] -= 1


@njit(cache=True, nogil=True)
def _take(keys: Keys, table_keys: Keys, table_count: NDArray[np.uint8]) -> None:
    """Enter points into voxels that are known already, full or not."""
    for i in range(keys.shape[0]):
        at = _slot(keys[i], table_keys)
        if table_keys[at] == keys[i]:
            table_count[at] = min(255, table_count[at] + 1)


@njit(cache=True, nogil=True)
def _refill(
    keys: Keys, counts: NDArray[np.uint8], ranges: NDArray[np.float32], table_keys: Keys,
    table_count: NDArray[np.uint8], table_range: NDArray[np.float32],
) -> None:  # fmt: skip
    for i in range(keys.shape[0]):
        at = _slot(keys[i], table_keys)
        table_keys[at] = keys[i]
        table_count[at] = counts[i]
        table_range[at] = ranges[i]


class VoxelTable:
    """Voxels of two sizes: fine where trunks are measured, coarse elsewhere."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._used = 0
        """Slots that carry a key, live or given back."""
        self._clear(_START_SLOTS)

    @property
    def nbytes(self) -> int:
        """Memory of the table."""
        return int(self._keys.nbytes + self._counts.nbytes + self._ranges.nbytes)

    def admit(
        self, points_m: NDArray[np.float32], T_map_points: Matrix, lows_m: NDArray[np.float32], shell_per_m: float = 0.0
    ) -> tuple[NDArray[np.bool_], Keys]:
        """Enter points (N, 3); return which of them got in, and the voxel of each.

        Args:
            points_m: in the frame of their camera.
            T_map_points: takes them to map.
            lows_m: lowest heights per cell of the map (``GroundGrid``).
            shell_per_m: times the range squared, how far along its ray a point may lie from a taken voxel and be known.
        """
        n = len(points_m)
        self.reserve(n)
        keep, keys = np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.int64)
        c = self._config
        self._used += int(_admit(
            points_m, T_map_points, lows_m, c.ground_cell_m, c.fine_low_m, c.fine_high_m, c.voxel_m, c.coarse_voxel_m,
            c.per_voxel, c.nearer, self._keys, self._counts, self._ranges, shell_per_m, keep, keys,
        ))  # fmt: skip
        return keep, keys

    def release(self, keys: Keys) -> None:
        """Give back the voxels of points that leave or move."""
        _release(keys, self._keys, self._counts)

    def take(self, keys: Keys) -> None:
        """Enter points that were refused by full voxels after all."""
        _take(keys, self._keys, self._counts)

    def reserve(self, more: int) -> None:
        """Grow so that the table stays at most two thirds full; voxels that were given back are forgotten then."""
        if 1.5 * (self._used + more) <= len(self._keys):
            return
        live = self._counts > 0
        keys, counts, ranges = self._keys[live], self._counts[live], self._ranges[live]
        slots = _START_SLOTS
        while 1.5 * (len(keys) + more) > slots:
            slots *= 2
        self._clear(slots)
        _refill(keys, counts, ranges, self._keys, self._counts, self._ranges)
        self._used = len(keys)

    def _clear(self, slots: int) -> None:
        self._keys: Keys = np.full(slots, -1, dtype=np.int64)
        self._counts = np.zeros(slots, dtype=np.uint8)
        self._ranges = np.zeros(slots, dtype=np.float32)
        self._used = 0
