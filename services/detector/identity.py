"""Trees keep their names: detections of one update are matched to those of the last, also after a map correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from services.detector.config import DetectorServiceConfig
from services.detector.model import Floats, Trunk


@dataclass(slots=True)
class TrackedTree:
    """A tree with its name."""

    tree_id: int
    trunk: Trunk
    observations: int
    """Updates that saw it."""
    missed: int
    """Updates since it was last seen."""
    expected_m: Floats
    """(3,) where its base should be now: the last position, moved with the map."""


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
        self._next = 1
        self.trees: list[TrackedTree] = []

    def clear(self) -> None:
        """Forget all trees (a new map); ids are never used again."""
        self.trees = []

    def update(self, trunks: Sequence[Trunk]) -> list[TreeEvent]:
        """Match a whole new detection, nearest pairs first, each side once; return what happened to whom.

        Two trees that became one trunk are merged at once, under the id that fits better; a trunk that was not seen is kept
        for a few updates, because a look from elsewhere may miss it.
        """
        pairs = sorted(
            (self._distance(tree, trunk), i, j)
            for i, tree in enumerate(self.trees)
            for j, trunk in enumerate(trunks)
            if self._alike(tree, trunk)
        )
        owner: dict[int, TrackedTree] = {}
        """Tree of each trunk."""
        matched: set[int] = set()
        before = {tree.tree_id: tree.trunk.radius_m for tree in self.trees}
        for _, i, j in pairs:
            if i in matched or j in owner:
                continue
            matched.add(i)
            tree = owner[j] = self.trees[i]
            tree.trunk, tree.missed, tree.observations = trunks[j], 0, tree.observations + 1
            tree.expected_m = np.array(trunks[j].base_m)
        events = self._lost([tree for i, tree in enumerate(self.trees) if i not in matched], trunks, owner)
        events += self._begun(trunks, owner, before)
        return events

    def _lost(
        self, lost: Sequence[TrackedTree], trunks: Sequence[Trunk], owner: dict[int, TrackedTree]
    ) -> list[TreeEvent]:
        """Count misses; withdraw what went into another tree, or was missed too often."""
        events: list[TreeEvent] = []
        for tree in lost:
            tree.missed += 1
            into = next((o for j, o in owner.items() if self._distance(tree, trunks[j]) < trunks[j].radius_m), None)
            if into is not None:
                events.append(TreeEvent("merged", tree.tree_id, into.tree_id))
            elif tree.missed >= self._config.forget_after:
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
            new = TrackedTree(self._next, trunk, 1, 0, np.array(trunk.base_m))
            self._next += 1
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

    def _alike(self, tree: TrackedTree, trunk: Trunk) -> bool:
        a, b = tree.trunk.radius_m, trunk.radius_m
        reach = self._config.same_tree_m + a + 3.0 * np.hypot(tree.trunk.sigma_xy_m, trunk.sigma_xy_m)
        return self._distance(tree, trunk) < reach and abs(a - b) < 0.05 + 0.5 * max(a, b)

    @staticmethod
    def _distance(tree: TrackedTree, trunk: Trunk) -> float:
        return float(np.hypot(tree.expected_m[0] - trunk.base_m[0], tree.expected_m[1] - trunk.base_m[1]))
