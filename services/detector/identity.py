"""Trees keep their names: detections of one update are matched to those of the last, also after a map correction."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from services.common.geometry import inverse
from services.detector.config import DetectorServiceConfig
from services.detector.map_store import Anchor, anchor_of, anchors_of
from services.detector.model import Floats, Trunk


@dataclass(slots=True)
class TrackedTree:
    """A tree with its name."""

    tree_id: int
    trunk: Trunk
    """As it was last seen, moved with the map since."""
    observations: int
    """Updates that saw it."""
    missed: int
    """Updates since it was last seen."""
    anchor: Anchor | None = None
    """The submap that its place was last measured against; None where none looks at it."""


@dataclass(frozen=True, slots=True)
class TreeEvent:
    """What became of a tree from one update to the next."""

    kind: Literal["appeared", "merged", "split", "gone"]
    tree_id: int
    other_id: int | None = None
    """merged: the tree it went into; split: the tree it came from."""

    def __str__(self) -> str:
        words = {"appeared": "is new", "merged": "went into tree", "split": "came apart from tree", "gone": "is gone"}
        other = "" if self.other_id is None else f" {self.other_id}"
        return f"tree {self.tree_id} {words[self.kind]}{other}"


class Identities:
    """Gives detections stable ids."""

    def __init__(self, config: DetectorServiceConfig) -> None:
        self._config = config
        self.next_id = 1
        self.trees: list[TrackedTree] = []

    def clear(self) -> None:
        """Forget all trees (a new map); ids are never used again."""
        self.trees = []

    def take_up(self, trees: Sequence[TrackedTree]) -> None:
        """Go on with the trees of an earlier run in the same map; their ids are below ``next_id``."""
        self.trees = list(trees)

    @property
    def anchors(self) -> dict[int, Floats]:
        """The submaps that trees are anchored to, with the poses (4, 4) that these had then."""
        return {t.anchor.submap_id: t.anchor.T_map_submap for t in self.trees if t.anchor is not None}

    def follow(self, poses: Mapping[int, Floats]) -> None:
        """Move each tree with its anchor to where ``poses`` (4, 4) now have that; another tree's serves where its own is gone.

        What no anchor leads stays where it was.
        """
        for tree, anchor in self._led_by(poses):
            if anchor is None:
                continue
            now = poses[anchor.submap_id]
            if not np.array_equal(now, anchor.T_map_submap):
                tree.trunk = _moved(tree.trunk, now @ inverse(anchor.T_map_submap))

    def forget_unled(self, poses: Mapping[int, Floats]) -> list[int]:
        """Forget the trees that no anchor leads to where they are in ``poses``; return their ids."""
        led = self._led_by(poses)
        self.trees = [tree for tree, anchor in led if anchor is not None]
        return [tree.tree_id for tree, anchor in led if anchor is None]

    def _led_by(self, poses: Mapping[int, Floats]) -> list[tuple[TrackedTree, Anchor | None]]:
        common = {submap_id: T for submap_id, T in self.anchors.items() if submap_id in poses}
        return [
            (t, t.anchor if t.anchor and t.anchor.submap_id in poses else anchor_of(np.array(t.trunk.base_m), common))
            for t in self.trees
        ]

    def fasten(self, poses: Mapping[int, Floats]) -> None:
        """Anchor each tree to the submap that looks at it most squarely, where ``poses`` (4, 4) have it."""
        anchors = anchors_of([np.array(tree.trunk.base_m) for tree in self.trees], poses)
        for tree, anchor in zip(self.trees, anchors, strict=True):
            tree.anchor = anchor

    def update(self, trunks: Sequence[Trunk], shown: Callable[[Floats], bool] = lambda _: True) -> list[TreeEvent]:
        """Match a whole new detection, nearest pairs first, each side once; return what happened to whom.

        ``shown`` tells whether the map shows a place (3,) at all: only there is a tree that is not seen withdrawn.

        Two trees that became one trunk are merged at once, under the id that fits better; a trunk that was not seen is kept
        for a few updates, because a look from elsewhere may miss it.
        """
        owner: dict[int, TrackedTree] = {}
        """Tree of each trunk."""
        matched: set[int] = set()
        before = {tree.tree_id: tree.trunk.radius_m for tree in self.trees}
        for _, i, j in self._pairs(trunks):
            if i in matched or j in owner:
                continue
            matched.add(i)
            tree = owner[j] = self.trees[i]
            tree.trunk, tree.missed, tree.observations = trunks[j], 0, tree.observations + 1
        events = self._lost([tree for i, tree in enumerate(self.trees) if i not in matched], trunks, owner, shown)
        events += self._begun(trunks, owner, before)
        return events

    def _lost(
        self,
        lost: Sequence[TrackedTree],
        trunks: Sequence[Trunk],
        owner: dict[int, TrackedTree],
        shown: Callable[[Floats], bool],
    ) -> list[TreeEvent]:
        """Count misses; withdraw what went into another tree, or was missed too often."""
        events: list[TreeEvent] = []
        for tree in lost:
            seen_there = shown(np.array(tree.trunk.base_m))
            tree.missed = tree.missed + 1 if seen_there else 1
            into = next((o for j, o in owner.items() if self._distance(tree, trunks[j]) < trunks[j].radius_m), None)
            if into is not None:
                events.append(TreeEvent("merged", tree.tree_id, into.tree_id))
            elif seen_there and tree.missed >= self._config.forget_after:
                events.append(TreeEvent("gone", tree.tree_id))
        withdrawn = {event.tree_id for event in events}
        self.trees = [t for t in self.trees if t.tree_id not in withdrawn]
        return events

    def _begun(
        self, trunks: Sequence[Trunk], owner: dict[int, TrackedTree], before: dict[int, float]
    ) -> list[TreeEvent]:
        """Give ids to trunks that have none; one that stands where a thicker tree was said to stand came apart from it."""
        events = []
        for j, trunk in enumerate(trunks):
            if j in owner:
                continue
            new = TrackedTree(self.next_id, trunk, 1, 0)
            self.next_id += 1
            origin = next(
                (o for o in owner.values() if o.tree_id in before
                 and self._distance(new, o.trunk) < before[o.tree_id] + trunk.radius_m < 2.0 * before[o.tree_id]), None,
            )  # fmt: skip
            self.trees.append(new)
            if origin is not None:
                events.append(TreeEvent("split", new.tree_id, origin.tree_id))
            else:
                events.append(TreeEvent("appeared", new.tree_id))
        return events

    def _pairs(self, trunks: Sequence[Trunk]) -> list[tuple[float, int, int]]:
        """Return which tree may be which trunk, the nearest first.

        Only trunks whose x is near the tree's are asked: in a large map each with each takes seconds.
        """
        by_x = sorted(range(len(trunks)), key=lambda j: trunks[j].base_m[0])
        xs = [trunks[j].base_m[0] for j in by_x]
        most_sigma_m = max((trunk.sigma_xy_m for trunk in trunks), default=0.0)
        pairs: list[tuple[float, int, int]] = []
        for i, tree in enumerate(self.trees):
            x, reach = tree.trunk.base_m[0], self._reach_m(tree, most_sigma_m)
            near = by_x[bisect_left(xs, x - reach) : bisect_right(xs, x + reach)]
            pairs += [(self._distance(tree, trunks[j]), i, j) for j in near if self._alike(tree, trunks[j])]
        return sorted(pairs)

    def _alike(self, tree: TrackedTree, trunk: Trunk) -> bool:
        a, b = tree.trunk.radius_m, trunk.radius_m
        near = self._distance(tree, trunk) < self._reach_m(tree, trunk.sigma_xy_m)
        return near and abs(a - b) < 0.05 + 0.5 * max(a, b)

    def _reach_m(self, tree: TrackedTree, sigma_m: float) -> float:
        doubt = float(np.hypot(tree.trunk.sigma_xy_m, sigma_m))
        return self._config.same_tree_m + tree.trunk.radius_m + 3.0 * doubt

    @staticmethod
    def _distance(tree: TrackedTree, trunk: Trunk) -> float:
        a, b = tree.trunk.base_m, trunk.base_m
        return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _moved(trunk: Trunk, T: Floats) -> Trunk:
    """Return a trunk moved by ``T`` (4, 4) of the map."""
    x, y, z = T[:3, :3] @ trunk.base_m + T[:3, 3]
    axis = T[:3, :3] @ trunk.axis
    ax, ay, az = axis / np.linalg.norm(axis)
    return replace(trunk, base_m=(float(x), float(y), float(z)), axis=(float(ax), float(ay), float(az)))
