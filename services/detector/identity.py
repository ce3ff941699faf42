"""Trees keep their names: detections of one update are matched to those of the last, also after a map correction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


class Identities:
    """Gives detections stable ids."""

    def __init__(self, config: DetectorServiceConfig) -> None:
        self._config = config
        self._next = 1
        self.trees: list[TrackedTree] = []

    def clear(self) -> None:
        """Forget all trees (a new map); ids are never used again."""
        self.trees = []

    def update(self, trunks: Sequence[Trunk]) -> None:
        """Match a whole new detection: nearest pairs first, each side once."""
        pairs = sorted(
            (self._distance(tree, trunk), i, j)
            for i, tree in enumerate(self.trees)
            for j, trunk in enumerate(trunks)
            if self._alike(tree, trunk)
        )
        matched_trees: set[int] = set()
        matched_trunks: set[int] = set()
        for _, i, j in pairs:
            if i in matched_trees or j in matched_trunks:
                continue
            matched_trees.add(i)
            matched_trunks.add(j)
            tree = self.trees[i]
            tree.trunk, tree.missed, tree.observations = trunks[j], 0, tree.observations + 1
            tree.expected_m = np.array(trunks[j].base_m)
        for i, tree in enumerate(self.trees):
            if i not in matched_trees:
                tree.missed += 1
        self.trees = [t for t in self.trees if t.missed < self._config.forget_after]
        for j, trunk in enumerate(trunks):
            if j not in matched_trunks:
                self.trees.append(TrackedTree(self._next, trunk, 1, 0, np.array(trunk.base_m)))
                self._next += 1

    def _alike(self, tree: TrackedTree, trunk: Trunk) -> bool:
        a, b = tree.trunk.radius_m, trunk.radius_m
        reach = self._config.same_tree_m + a + 3.0 * np.hypot(tree.trunk.sigma_xy_m, trunk.sigma_xy_m)
        return self._distance(tree, trunk) < reach and abs(a - b) < 0.05 + 0.5 * max(a, b)

    @staticmethod
    def _distance(tree: TrackedTree, trunk: Trunk) -> float:
        return float(np.hypot(tree.expected_m[0] - trunk.base_m[0], tree.expected_m[1] - trunk.base_m[1]))
