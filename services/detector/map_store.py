"""What the detector holds of the map: submaps, their points in the map frame, and from where they were seen."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.mapping import MapIndex, Submap
from services.detector.incremental import Cells, cells_of
from services.detector.model import Floats, Views

_PATIENCE_S = (2.0, 30.0)
"""Least and longest time between two questions that do not help."""
_NEAREST_M = 0.3
_RANGE_M = 6.0
"""As far as the mapper believes the depth image."""
_TRUNK_M = 0.6
"""Radius of the thickest."""


@dataclass(slots=True)
class _Held:
    version: int
    T_map_submap: Floats
    local_m: NDArray[np.float32] = field(repr=False)
    map_m: NDArray[np.float32] = field(repr=False)
    view: NDArray[np.int32] = field(repr=False)
    origins_local_m: Floats = field(repr=False)
    tan_half: tuple[float, float] = (0.0, 0.0)
    placed_by: int = 0
    """Version of the graph that placed it."""
    cells: Cells = frozenset()
    """Of the plan, that its points are in."""


class MapStore:
    """Submaps by id, in order of arrival."""

    def __init__(self) -> None:
        self.map_id = ""
        self.graph_version = 0
        self.changed_points = 0
        """Points that came, went or moved since ``settle``."""
        self._touched: Cells = frozenset()
        self.epoch: int | None = None
        """The run of the mapper whose versions these are; None until an index told."""
        self._index: MapIndex | None = None
        """The last that was heard of this map."""
        self._absent: set[int] = set()
        """Held here, not listed in the last index: gone, or newer than the index."""
        self._moved_unseen: set[int] = set()
        """Submaps that were moved but whose points never came, since the last index."""
        self._patience_s, self._not_before_ns = _PATIENCE_S[0], 0
        self._held: dict[int, _Held] = {}

    def __len__(self) -> int:
        return sum(len(h.local_m) for h in self._held.values())

    def clear(self, map_id: str) -> None:
        """Begin a new map."""
        self.map_id, self.graph_version, self._held, self._index = map_id, 0, {}, None
        self.changed_points, self._touched, self._moved_unseen = 0, frozenset(), set()
        self._patience_s, self._not_before_ns = _PATIENCE_S[0], 0

    def settle(self) -> Cells:
        """Note that all changes have been looked at; return the cells of the plan that they touched."""
        touched, self._touched, self.changed_points = self._touched, frozenset(), 0
        return touched

    def take(self, submap: Submap) -> bool:
        """Take up a submap message; return False when its points are missing here (``missing`` names it)."""
        self.graph_version = max(self.graph_version, submap.graph_version)
        held = self._held.get(submap.submap_id)
        self._moved_unseen.discard(submap.submap_id)
        if submap.removed:
            self._drop({submap.submap_id} & set(self._held))
            return True
        if len(submap.points_m) == 0 and (held is None or held.version != submap.version):
            self._moved_unseen.add(submap.submap_id)
            return False
        if held is not None and (submap.version, submap.graph_version) < (held.version, held.placed_by):
            return True  # an answer to a query that a newer delta has overtaken
        T = submap.T_map_submap
        self._touched |= held.cells if held is not None else frozenset()
        if held is None or held.version != submap.version:
            held = _Held(
                submap.version, T, submap.points_m, _placed(submap.points_m, T), submap.view.astype(np.int32),
                submap.origins_m.astype(np.float64), _field_of_view(submap.points_m),
            )  # fmt: skip
            self._held[submap.submap_id] = held
        else:
            held.T_map_submap, held.map_m = T, _placed(held.local_m, T)
        held.placed_by = submap.graph_version
        held.cells = cells_of(held.map_m)
        self._touched |= held.cells
        self.changed_points += len(held.local_m)
        return True

    def lacks(self, index: MapIndex, now_ns: int) -> bool:
        """Return whether the mapper holds more or newer than this store, so that what is ``missing`` is to be asked for.

        What the mapper does not hold any more, two indexes in a row, goes. Asking is answered with yes at most every 2 s, and ever more seldom
        (to 30 s) while it does not help. An index of another map is nothing to go by: its submaps come first.
        """
        if index.map_id != self.map_id:
            return False
        if index.epoch != self.epoch:
            if self.epoch is not None:
                self._drop(set(self._held))  # versions of another run of the mapper
            self.epoch = index.epoch
        absent = set(self._held) - set(index.submap_ids)
        self._drop(absent & self._absent)
        self._absent = absent - self._absent
        self._index, self._moved_unseen = index, set()
        if self.complete:
            self._patience_s = _PATIENCE_S[0]
            return False
        if now_ns < self._not_before_ns:
            return False
        self._not_before_ns = now_ns + round(self._patience_s * 1e9)
        self._patience_s = min(2.0 * self._patience_s, _PATIENCE_S[1])
        return True

    def was_helped(self) -> None:
        """Note that a question brought something: the next one need not wait long."""
        self._patience_s, self._not_before_ns = _PATIENCE_S[0], 0

    @property
    def complete(self) -> bool:
        """Whether an index of this map was heard and all that it lists is held."""
        return self._index is not None and not any(True for _ in self._listed_not_held())

    def missing(self) -> list[int]:
        """Return the submaps whose points are not here, or not the newest, as far as is known, the oldest first."""
        return sorted(self._moved_unseen.union(self._listed_not_held()))

    def _listed_not_held(self) -> Iterator[int]:
        if self._index is None:
            return
        entries = zip(self._index.submap_ids, self._index.versions, self._index.placed_by, strict=True)
        yield from (entry[0] for entry in entries if not self._is_as_new(*entry))

    def _is_as_new(self, submap_id: int, version: int, placed_by: int) -> bool:
        held = self._held.get(submap_id)
        return held is not None and held.version >= version and held.placed_by >= placed_by

    def _drop(self, submap_ids: set[int]) -> None:
        for submap_id in submap_ids:
            gone = self._held.pop(submap_id)
            self.changed_points += len(gone.local_m)
            self._touched |= gone.cells

    def assemble(self) -> tuple[NDArray[np.float32], Views]:
        """Return all points in the map frame (N, 3) and their views."""
        points, index, origins, rotations = [np.zeros((0, 3), dtype=np.float32)], [np.zeros(0, dtype=np.int32)], [], []
        tan_half = (0.0, 0.0)
        count = 0
        for held in self._held.values():
            T = held.T_map_submap
            points.append(held.map_m)
            index.append(held.view + np.int32(count))
            origins.append(held.origins_local_m @ T[:3, :3].T + T[:3, 3])
            rotations.extend([T[:3, :3]] * len(held.origins_local_m))
            count += len(held.origins_local_m)
            tan_half = (max(tan_half[0], held.tan_half[0]), max(tan_half[1], held.tan_half[1]))
        views = Views(
            np.concatenate(index), np.concatenate(origins) if origins else np.zeros((0, 3)),
            np.array(rotations) if rotations else None, tan_half if min(tan_half) > 0.0 else None,
        )  # fmt: skip
        return np.concatenate(points), views

    def shows(self, position_m: Floats) -> bool:
        """Return whether a camera of the map looked at a place (3,), or so near it that a trunk there would show.

        From above: within its field of view and its range.
        """
        for held in self._held.values():
            T = held.T_map_submap
            level = np.array([position_m[0], position_m[1], T[2, 3]]) - T[:3, 3]
            right, ahead = float(T[:3, 0] @ level), float(T[:3, 2] @ level)
            if _NEAREST_M < ahead < _RANGE_M + _TRUNK_M and abs(right) < held.tan_half[0] * ahead + _TRUNK_M:
                return True
        return False

    def poses(self) -> dict[int, Floats]:
        """Return where each submap stands."""
        return {submap_id: held.T_map_submap for submap_id, held in self._held.items()}


@dataclass(frozen=True, slots=True)
class Anchor:
    """A submap and where it stood: what a place of the map is remembered by."""

    submap_id: int
    T_map_submap: Floats
    """(4, 4)."""


def anchor_of(position_m: Floats, poses: Mapping[int, Floats], reach_m: float = _RANGE_M) -> Anchor | None:
    """Return the submap of ``poses`` (by id) that looks at a place (3,) most squarely, None when none does."""
    return anchors_of([position_m], poses, reach_m)[0]


def anchors_of(
    positions_m: Sequence[Floats], poses: Mapping[int, Floats], reach_m: float = _RANGE_M
) -> list[Anchor | None]:
    """Return the same for several places: the poses are stacked once."""
    if not poses:
        return [None] * len(positions_m)
    submap_ids, stacked = list(poses), np.array(list(poses.values()))
    at, ahead = stacked[:, :2, 3], stacked[:, :2, 2]
    found: list[Anchor | None] = []
    for position_m in positions_m:
        to = position_m[:2] - at
        distance = np.hypot(to[:, 0], to[:, 1])
        near = (distance > _NEAREST_M) & (distance < reach_m)
        forward = np.where(near, (ahead * to).sum(axis=1) / np.maximum(distance, _NEAREST_M), 0.0)
        best = int(np.argmax(forward))
        found.append(Anchor(submap_ids[best], poses[submap_ids[best]]) if forward[best] > 0.0 else None)
    return found


def _placed(points_m: NDArray[np.float32], T: Floats) -> NDArray[np.float32]:
    return (points_m @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)).astype(np.float32)


def _field_of_view(points_m: NDArray[np.float32]) -> tuple[float, float]:
    """Return the tangents of half the field of view (horizontal, vertical) that the points of a camera span."""
    far = points_m[points_m[:, 2] > 0.5]
    if len(far) < 100:
        return (0.0, 0.0)
    x, y = np.abs(far[:, 0] / far[:, 2]), np.abs(far[:, 1] / far[:, 2])
    return float(np.percentile(x, 99.5)), float(np.percentile(y, 99.5))
