"""The dense map: one submap per keyframe, re-anchored when the graph changes, bounded by the surface it covers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import inverse, log_rotation
from services.mapper.cloud import KeyframeCloud
from services.mapper.config import MapperConfig
from services.mapper.ground_grid import GroundGrid
from services.mapper.voxel_table import VoxelTable

Matrix = NDArray[np.float64]

_ARM_M = 3.0
"""Distance at which a submap's turn is felt as a shift."""
_ALIKE_M, _ALIKE_COSINE = 1.0, 0.9
"""Two cameras so near and so little turned (25 degrees) look at the same."""
_SMALL_LOSS = 0.05
"""A moved submap that would lose a smaller share of its points keeps them: not worth sending it again."""
_NO_KEYS = np.zeros(0, dtype=np.int64)


@dataclass(slots=True)
class MapSubmap:
    """What the map holds of one keyframe. Arrays are replaced, never written to: others may hold them."""

    submap_id: int
    stamp_ns: int
    points_m: NDArray[np.float32] = field(repr=False)
    """(N, 3) in the keyframe's camera frame."""
    rgb: NDArray[np.uint8] = field(repr=False)
    T_map_submap: Matrix
    version: int = 1
    """Of the points."""
    anchor_id: int = 0
    """The keyframe whose pose places it: its own, or the nearest left when slam culled that."""
    T_anchor_submap: Matrix = field(default_factory=lambda: np.eye(4))
    """Identity unless the anchor is another keyframe's, or registration moved the cloud."""
    keys: NDArray[np.int64] = field(default_factory=lambda: _NO_KEYS, repr=False)
    """(N,) the voxel that each point has taken."""
    T_keyed: Matrix = field(default_factory=lambda: np.eye(4))
    """Where the submap stood when it took them."""
    T_map_anchor: Matrix | None = field(default=None, repr=False)
    """The anchor's pose that it was last placed by."""
    sent_graph: int = 0
    """Version of the graph under which it was last told of."""


@dataclass(frozen=True, slots=True)
class MapCloud:
    """The whole map in the map frame: points (N, 3) float32 and colours (N, 3) uint8 RGB."""

    points_m: NDArray[np.float32]
    rgb: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Moves:
    """What a new graph changed."""

    moved: list[MapSubmap]
    """Same points, another place."""
    thinned: list[MapSubmap]
    """Lost the points for which another submap stands: doubled surfaces that became one."""


class DenseMap:
    """Submaps by keyframe id, in order of arrival. Poses come from slam; what did not move is not touched."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self.map_id = ""
        self.size = 0
        """Number of points."""
        self.submaps: dict[int, MapSubmap] = {}
        self.ground = GroundGrid(config.ground_cell_m)
        self._voxels = VoxelTable(config)
        self._cameras: dict[tuple[int, int], list[int]] = {}
        """Keyframes by the cell of the map that they were made in."""

    @property
    def nbytes(self) -> int:
        """Memory of points, colours, their voxels and the voxel table; the ground grid's fixed 4 MB apart."""
        each = sum(s.points_m.nbytes + s.rgb.nbytes + s.keys.nbytes for s in self.submaps.values())
        return each + self._voxels.nbytes

    def reset(self, map_id: str) -> list[MapSubmap]:
        """Begin a new map; return the submaps of the old one."""
        gone = list(self.submaps.values())
        self.submaps, self.size, self.map_id = {}, 0, map_id
        self.ground = GroundGrid(self._config.ground_cell_m)
        self._voxels = VoxelTable(self._config)
        self._cameras = {}
        return gone

    def add(
        self, keyframe_id: int, stamp_ns: int, cloud: KeyframeCloud, T_map_camera: Matrix,
        T_camera_cloud: Matrix | None = None,
    ) -> list[MapSubmap]:  # fmt: skip
        """Take up a keyframe's cloud; return the submaps whose points changed (itself, and any thinned for memory).

        ``T_camera_cloud`` is what registration found: the cloud's own little correction, which then rides on the keyframe.
        """
        own = np.eye(4) if T_camera_cloud is None else T_camera_cloud
        T = T_map_camera @ own
        self.ground.take(cloud.points_m, T)
        c = self._config
        shell = c.shell_sigmas * c.range_noise_per_m if self._often_seen(T) else 0.0
        keep, keys = self._voxels.admit(cloud.points_m, T, self.ground.lows_m, shell)
        self._cameras.setdefault(_cell(T), []).append(keyframe_id)
        submap = MapSubmap(
            keyframe_id, stamp_ns, cloud.points_m[keep], cloud.rgb[keep], T, anchor_id=keyframe_id,
            T_anchor_submap=own, keys=keys[keep], T_keyed=T,
        )  # fmt: skip
        self.submaps[keyframe_id] = submap
        self.size += len(submap.points_m)
        return [submap, *self._thin()]

    def restore(self, submaps: list[MapSubmap]) -> None:
        """Take up the submaps of a saved map, all their points, as they stand."""
        for submap in submaps:
            self.ground.take(submap.points_m, submap.T_map_submap)
            keep, keys = self._voxels.admit(submap.points_m, submap.T_map_submap, self.ground.lows_m)
            self._voxels.take(keys[~keep])
            submap.keys, submap.T_keyed = keys, submap.T_map_submap
            self._cameras.setdefault(_cell(submap.T_map_submap), []).append(submap.submap_id)
            self.submaps[submap.submap_id] = submap
            self.size += len(submap.points_m)

    def move(self, poses: Mapping[int, Matrix]) -> Moves:
        """Place submaps by a graph's poses (keyframe id to T_map_camera); return those that moved noticeably.

        A pose that is the same object as last time is known not to have changed.
        """
        for submap in self.submaps.values():  # before any is placed: one graph may cull a keyframe and move the others
            if submap.anchor_id not in poses:
                self._anchor_elsewhere(submap, poses)
        moved = []
        for submap in self.submaps.values():
            T = poses.get(submap.anchor_id)
            if T is None or T is submap.T_map_anchor:
                continue
            submap.T_map_anchor = T
            new = T @ submap.T_anchor_submap
            if self._differs(submap.T_map_submap, new):
                submap.T_map_submap = new
                moved.append(submap)
        thinned = self._rekey([s for s in moved if shift_m(s.T_keyed, s.T_map_submap) > self._config.rekey_m])
        ids = {s.submap_id for s in thinned}
        return Moves([s for s in moved if s.submap_id not in ids], thinned)

    def cloud(self) -> MapCloud:
        """Return the whole map as one cloud."""
        points, rgb = [np.zeros((0, 3), dtype=np.float32)], [np.zeros((0, 3), dtype=np.uint8)]
        for s in self.submaps.values():
            T = s.T_map_submap
            points.append((s.points_m @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
            rgb.append(s.rgb)
        return MapCloud(np.concatenate(points), np.concatenate(rgb))

    def _often_seen(self, T_map_camera: Matrix) -> bool:
        """Return whether enough keyframes looked this way from here: more would only fill the noise around the surfaces."""
        a, b = _cell(T_map_camera)
        looks = 0
        for cell in ((a + i, b + j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
            for k in self._cameras.get(cell, ()):
                looks += _alike(T_map_camera, self.submaps[k].T_map_submap)
                if looks >= self._config.enough_looks:
                    return True
        return False

    def _rekey(self, submaps: list[MapSubmap]) -> list[MapSubmap]:
        """Let far moved submaps take the voxels of their new place; return those that lost points to others there."""
        for submap in submaps:
            self._voxels.release(submap.keys)
        thinned = []
        for submap in submaps:
            T = submap.T_map_submap
            self.ground.take(submap.points_m, T)
            keep, submap.keys = self._voxels.admit(submap.points_m, T, self.ground.lows_m)
            submap.T_keyed = T
            if np.count_nonzero(keep) >= (1.0 - _SMALL_LOSS) * len(keep):
                self._voxels.take(submap.keys[~keep])
                continue
            self._keep_only(submap, keep)
            thinned.append(submap)
        return thinned

    def _keep_only(self, submap: MapSubmap, keep: NDArray[np.bool_]) -> None:
        """Drop points whose voxels are not (or no longer) counted."""
        self.size -= len(keep) - int(np.count_nonzero(keep))
        submap.points_m, submap.rgb, submap.keys = submap.points_m[keep], submap.rgb[keep], submap.keys[keep]
        submap.version += 1

    def _anchor_elsewhere(self, submap: MapSubmap, poses: Mapping[int, Matrix]) -> None:
        """Hang the submap of a culled keyframe on the keyframe nearest in time, where it stands now."""
        others = [k for k in poses if k in self.submaps and self.submaps[k].anchor_id == k]
        if not others:
            return
        anchor = min(others, key=lambda k: (abs(k - submap.anchor_id), k))
        at = self.submaps[anchor]
        T_map_anchor = at.T_map_submap @ inverse(at.T_anchor_submap)
        submap.T_anchor_submap = inverse(T_map_anchor) @ submap.T_map_submap
        submap.anchor_id, submap.T_map_anchor = anchor, None

    def _differs(self, a: Matrix, b: Matrix) -> bool:
        if float(np.abs(a[:3, 3] - b[:3, 3]).max()) > self._config.move_m:
            return True
        return float(np.linalg.norm(log_rotation(a[:3, :3].T @ b[:3, :3]))) > self._config.move_rad

    def _thin(self) -> list[MapSubmap]:
        """Halve the oldest submaps until the map keeps its bound; return those that were."""
        changed: list[MapSubmap] = []
        for submap in self.submaps.values():
            if self.size <= self._config.max_points:
                break
            if len(submap.points_m) < 1000:
                continue
            keep = np.arange(len(submap.points_m)) % 2 == 0
            self._voxels.release(submap.keys[~keep])
            self._keep_only(submap, keep)
            changed.append(submap)
        return changed


def _cell(T: Matrix) -> tuple[int, int]:
    return int(np.floor(T[0, 3] / _ALIKE_M)), int(np.floor(T[1, 3] / _ALIKE_M))


def _alike(a: Matrix, b: Matrix) -> bool:
    return float(a[:3, 2] @ b[:3, 2]) > _ALIKE_COSINE and float(np.abs(a[:3, 3] - b[:3, 3]).max()) < _ALIKE_M


def shift_m(a: Matrix, b: Matrix) -> float:
    """Return about how far a submap's points went between two of its poses."""
    turn = float(np.linalg.norm(log_rotation(a[:3, :3].T @ b[:3, :3])))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])) + _ARM_M * turn
