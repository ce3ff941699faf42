"""Which voxels of the map are taken, by how many points, and seen from how near. A hash table with linear probing.

Points enter only where their voxel is not full yet, so that looking again at the same place costs no memory; a voxel
also takes what was seen from clearly nearer, because depth noise grows with the square of range. What leaves the map,
or moves within it, gives its voxels back.

The table grows segment by segment, each at another fill: no keyframe waits while millions of voxels are moved.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.mapper.config import MapperConfig

Matrix = NDArray[np.float64]
Keys = NDArray[np.int64]

_SEGMENTS = 64
_START_SLOTS = 1024
"""Of a segment."""
_SPARE_POINTS = 400_000
"""The map's bound is kept after a keyframe has entered: so many points may be above it meanwhile."""
_WORTH = 0.1
"""A segment that cannot grow is tidied once such a share of it was given back; until then it refuses what is new."""
_FREE = np.int64(0)
"""Key of a slot that was never taken; the voxel that would have it is ten kilometres away."""


class Table(NamedTuple):
    """The slots: segment after segment, each with room for the largest it can become.

    Untouched room is no memory: the system gives a page when it is first written to.
    """

    keys: Keys
    counts: NDArray[np.uint8]
    ranges: NDArray[np.float32]
    slots: Keys
    """(segments,) slots in use of each."""
    used: Keys
    """(segments,) slots that carry a key, live or given back."""
    dead: Keys
    """(segments,) those that were given back."""


@njit(cache=True, nogil=True)
def _slot(key: np.int64, t: Table) -> int:
    """Return the slot of a key, or the free one where it belongs."""
    # Fibonacci hashing (Knuth, TAOCP 3, 6.4): the upper bits are the mixed ones. The first choose the segment, the next
    # the slot in it.
    h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    segments = t.slots.shape[0]
    whole = (h >> np.uint64(32)) * np.uint64(segments)
    segment, part = np.int64(whole >> np.uint64(32)), whole & np.uint64(0xFFFFFFFF)
    n = t.slots[segment]
    base = segment * (t.keys.shape[0] // segments)
    at = np.int64((part * np.uint64(n)) >> np.uint64(32))
    while t.keys[base + at] != _FREE and t.keys[base + at] != key:
        at += np.int64(1)
        if at == n:
            at = np.int64(0)
    return int(base + at)


@njit(cache=True, nogil=True)
def _segment(at: int, t: Table) -> int:
    return at // (t.keys.shape[0] // t.slots.shape[0])


@njit(cache=True, nogil=True)
def _key(x: float, y: float, z: float, voxel: float, level: np.int64) -> np.int64:
    key = np.int64(np.floor(x / voxel)) + 1048576
    key = key * np.int64(2097152) + np.int64(np.floor(y / voxel)) + 1048576
    return key * np.int64(2097152) + 2 * (np.int64(np.floor(z / voxel)) + 524288) + level


@njit(cache=True, nogil=True)
def _most(segment: int, slots: int, segments: int) -> int:
    """Return how many keys a segment of so many slots takes: a third to two thirds of them, so that not all grow at once."""
    return int(slots / 3.0 * 2.0 ** (segment / segments))


@njit(cache=True, nogil=True)
def _take_slot(at: int, key: np.int64, t: Table) -> int:
    """Write a new key into its free slot; return its slot after the segment may have grown, -1 when there is no room."""
    segments = t.slots.shape[0]
    room = t.keys.shape[0] // segments
    segment = _segment(at, t)
    if t.used[segment] < _most(segment, t.slots[segment], segments):
        t.keys[at] = key
        t.used[segment] += 1
        return at
    if t.slots[segment] == room and t.dead[segment] < _WORTH * room:
        return -1
    _grow(segment, t)
    at = _slot(key, t)
    t.keys[at] = key
    t.used[segment] += 1
    return at


@njit(cache=True, nogil=True)
def _grow(segment: int, t: Table) -> None:
    """Give a segment the slots that its live keys need; those that were given back are forgotten."""
    segments = t.slots.shape[0]
    room = t.keys.shape[0] // segments
    base, n = segment * room, t.slots[segment]
    live = np.flatnonzero(t.counts[base : base + n]) + base
    keys, counts, ranges = t.keys[live], t.counts[live], t.ranges[live]
    while n < room and len(live) >= 0.75 * _most(segment, n, segments):
        n = min(2 * n, room)
    t.slots[segment], t.used[segment], t.dead[segment] = n, len(live), 0
    t.keys[base : base + n] = _FREE
    t.counts[base : base + n] = 0
    for i in range(len(live)):
        at = _slot(keys[i], t)
        t.keys[at], t.counts[at], t.ranges[at] = keys[i], counts[i], ranges[i]


@njit(cache=True, nogil=True)
def _known_along(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, steps: int, voxel: float, level: np.int64,
    farthest: float, t: Table,
) -> bool:  # fmt: skip
    """Tell whether a voxel within so many steps along the ray holds a point seen from nearer than ``farthest``."""
    for step in range(1, steps + 1):
        for f in (-float(step), float(step)):
            key = _key(x + f * dx, y + f * dy, z + f * dz, voxel, level)
            at = _slot(key, t)
            if t.keys[at] == key and t.counts[at] > 0 and t.ranges[at] <= farthest:
                return True
    return False


@njit(cache=True, nogil=True)
def _admit(
    points: NDArray[np.float32], T: Matrix, lows: NDArray[np.float32], cell: float, fine_low: float, fine_high: float,
    fine: float, coarse: float, per_voxel: int, nearer: float, t: Table, shell: float, keep: NDArray[np.bool_],
    keys: Keys,
) -> None:  # fmt: skip
    """Enter points; mark those that their voxel takes and name each one's voxel.

    With ``shell`` above zero a point is known already when a voxel is taken within ``shell r^2`` along its ray.
    """
    half = lows.shape[0] // 2
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
        keep[i] = False
        at = _slot(key, t)
        r = np.sqrt(px * px + py * py + pz * pz)
        if shell > 0.0 and t.counts[at] == 0:
            s = voxel / max(r, 0.1)
            dx, dy, dz = s * (x - T[0, 3]), s * (y - T[1, 3]), s * (z - T[2, 3])
            steps = int(shell * r * r / voxel)
            if _known_along(x, y, z, dx, dy, dz, steps, voxel, level, r / nearer, t):
                continue
        if t.keys[at] == _FREE:
            at = _take_slot(at, key, t)
            if at < 0:
                continue
        elif t.counts[at] == 0:
            t.dead[_segment(at, t)] -= 1
        if t.counts[at] == 0:
            t.counts[at] = 1
            t.ranges[at] = r
            keep[i] = True
        elif t.counts[at] < per_voxel or r < nearer * t.ranges[at]:
            t.counts[at] = min(255, t.counts[at] + 1)
            t.ranges[at] = min(t.ranges[at], r)
            keep[i] = True


@njit(cache=True, nogil=True)
def _release(keys: Keys, t: Table) -> None:
    for i in range(keys.shape[0]):
        at = _slot(keys[i], t)
        if t.keys[at] == keys[i] and t.counts[at] > 0:
            t.counts[at] -= 1
            t.dead[_segment(at, t)] += t.counts[at] == 0


@njit(cache=True, nogil=True)
def _take(keys: Keys, t: Table) -> None:
    """Enter points into voxels that are known already, full or not."""
    for i in range(keys.shape[0]):
        at = _slot(keys[i], t)
        if t.keys[at] == keys[i]:
            t.dead[_segment(at, t)] -= t.counts[at] == 0
            t.counts[at] = min(255, t.counts[at] + 1)


class VoxelTable:
    """Voxels of two sizes: fine where trunks are measured, coarse elsewhere."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        room = _START_SLOTS
        while room * _SEGMENTS < 3 * (config.max_points + _SPARE_POINTS):
            room *= 2
        total = room * _SEGMENTS
        self._table = Table(
            np.zeros(total, np.int64), np.zeros(total, np.uint8), np.empty(total, np.float32),
            np.full(_SEGMENTS, _START_SLOTS), np.zeros(_SEGMENTS, np.int64), np.zeros(_SEGMENTS, np.int64),
        )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Memory of the slots in use."""
        each = self._table.keys.itemsize + self._table.counts.itemsize + self._table.ranges.itemsize
        return each * int(self._table.slots.sum())

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
        keep, keys = np.empty(n, dtype=np.bool_), np.empty(n, dtype=np.int64)
        c = self._config
        _admit(
            points_m, T_map_points, lows_m, c.ground_cell_m, c.fine_low_m, c.fine_high_m, c.voxel_m, c.coarse_voxel_m,
            c.per_voxel, c.nearer, self._table, shell_per_m, keep, keys,
        )  # fmt: skip
        return keep, keys

    def release(self, keys: Keys) -> None:
        """Give back the voxels of points that leave or move."""
        _release(keys, self._table)

    def take(self, keys: Keys) -> None:
        """Enter points that were refused by full voxels after all."""
        _take(keys, self._table)
