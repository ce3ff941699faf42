"""Loop closing: recognise a place seen before, check it by geometry, and make the map agree with itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.common.geometry import inverse, pose
from services.slam.atlas import Atlas, neighbours
from services.slam.binary import match_all
from services.slam.camera import CameraModel
from services.slam.config import SlamConfig
from services.slam.features import Features
from services.slam.links import Keyframes, Points, describe, merge, observe, points_of, shared_counts
from services.slam.mapping import Mapping
from services.slam.match import keep_common_turn
from services.slam.places import Bag, Places
from services.slam.posegraph import Edges, expect_nodes, optimise
from services.slam.tracking import MATCH_BLIND, Tracked, Tracking, moved
from services.slam.verify import told_by_close

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_NEAR_M = 2.0
_NEAR_RAD = 0.6
"""A keyframe that looks from about here to about there is worth a check even if the words disagree."""
_CHECKS = 3
"""Candidates checked by geometry per keyframe."""
_MIN_INLIERS = 45
_FOUND_LEAST = 0.12
"""A loop's matches are this share of what should be seen from there, and enough have measured depth. True loops of a forest have 67 and 0.27 at least; a backdrop seen from two places two metres apart 85 matches, 4 of them close, and 0.07."""
_WINDOW_PX = 8.0
_COVISIBLE = 15
"""Shared points that make two keyframes neighbours."""


@dataclass(frozen=True, slots=True)
class Correction:
    """A loop that was closed."""

    jump_m: float
    jump_rad: float


class Loops:
    """Finds and closes loops, one keyframe at a time; also finds a lost frame's place in the map."""

    def __init__(self, mapping: Mapping, tracking: Tracking, places: Places, config: SlamConfig) -> None:
        self.mapping = mapping
        self.tracking = tracking
        self.places = places
        self.config = config
        self.closed = 0
        """Counts corrections by loops, each loop's graph and its adjustment."""

    @property
    def atlas(self) -> Atlas:
        """Return the map."""
        return self.mapping.atlas

    @property
    def camera(self) -> CameraModel:
        """Return the camera."""
        return self.mapping.camera

    def remember(self, k: int) -> Bag:
        """Note what the new keyframe ``k`` looks like: it is found again by that, for a loop or after being lost."""
        with self.mapping.step():
            kf = self.atlas.keyframes
            bag = self.places.add(int(kf.serial[k]), kf.desc[k, : kf.n[k]])
            self.places.keep_only({int(s) for s in kf.serial[kf.n > 0]})
            return bag

    def consider(self, k: int, bag: Bag) -> Correction | None:
        """Look whether the new keyframe ``k``, which looks like ``bag``, closes a loop; if so correct the map."""
        expect_nodes(len(self.atlas.slots))
        with self.mapping.step():
            candidates = self._candidates(k, bag)
        for candidate in candidates:
            turned = self.mapping.turned
            found = self._verify(k, candidate)
            if found is not None and self.mapping.turned is turned:  # else: found in which of the two maps?
                return self.close(k, candidate, found, turned)
        return None

    def _candidates(self, k: int, bag: Bag) -> list[int]:
        """Return keyframe slots worth a check, best first: alike or near, and neither covisible with k nor its family."""
        atlas = self.atlas
        kf = atlas.keyframes
        near = neighbours(atlas, k, _COVISIBLE, 1000)
        family = {k, *(int(s) for s in near)}
        for s in near[:5]:
            family |= {int(x) for x in neighbours(atlas, int(s), 2 * _COVISIBLE, 10)}
        scores = self.places.scores(bag)
        kin = [scores[int(kf.serial[s])] for s in near if int(kf.serial[s]) in scores]
        least = 0.8 * min(kin) if kin else 0.05
        rated = []
        for s in atlas.slots:
            if int(s) in family:
                continue
            distance_m, angle_rad = moved(kf.R[k], kf.t[k], kf.R[s], kf.t[s])
            beside = distance_m < _NEAR_M and angle_rad < _NEAR_RAD
            score = scores.get(int(kf.serial[s]), 0.0)
            if score >= least or (beside and score >= 0.5 * least):
                rated.append((-score * (1.5 if beside else 1.0), int(kf.serial[s]), int(s)))
        return self._spread(sorted(rated))

    def _spread(self, rated: list[tuple[float, int, int]]) -> list[int]:
        """Return the best candidates, one of each covisible group."""
        chosen: list[int] = []
        taken: set[int] = set()
        for _, _, s in rated:
            if s in taken:
                continue
            chosen.append(s)
            taken |= {s, *(int(x) for x in neighbours(self.atlas, s, 2 * _COVISIBLE, 10))}
            if len(chosen) == _CHECKS:
                break
        return chosen

    def _verify(self, k: int, candidate: int) -> Tracked | None:
        """Return where keyframe ``k`` stands seen from the candidate's part of the map, with its matches there."""
        found = self.place(self.atlas.features_of(k), candidate)
        return found if found is not None and settles(found) else None

    def place(self, features: Features, candidate: int) -> Tracked | None:
        """Locate features against one keyframe and its neighbours, without any prior; None when they do not fit."""
        atlas = self.atlas
        with self.mapping.step():
            kf = atlas.keyframes
            has = np.flatnonzero(kf.point[candidate, : kf.n[candidate]] >= 0)
            known, desc = kf.point[candidate, has].copy(), kf.desc[candidate, has].copy()
            angle, place = kf.angle[candidate, has].astype(float), atlas.points.pos[known].copy()
        if len(has) < 15:
            return None
        match = match_all(desc, features.desc, MATCH_BLIND, 0.85)
        keep_common_turn(match, angle, features.angle)
        with self.mapping.step():
            rough = self.tracking.locate_by_ransac(features, place, match, known)
            if rough is None or rough.inliers < 12:
                return None
            group = np.concatenate([[candidate], neighbours(atlas, candidate, _COVISIBLE, 10)]).astype(np.int32)
            located = self.tracking.join_keyframes(rough, group, _WINDOW_PX)
            return None if located is None else self.tracking.join_keyframes(located, group, 0.5 * _WINDOW_PX)

    def close(self, k: int, candidate: int, found: Tracked, turned: F64) -> Correction:
        """Correct the poses by a pose graph, join the points of both sides, then adjust everything.

        ``found`` is of when ``mapping.turned`` was ``turned``.
        """
        atlas, mapping = self.atlas, self.mapping
        with mapping.step():
            kf = atlas.keyframes
            jump_m, jump_rad = moved(kf.R[k], kf.t[k], found.R, found.t)
            group = np.concatenate([[candidate], neighbours(atlas, candidate, _COVISIBLE, 10)]).astype(np.int32)
            old_points = points_of(atlas.points, kf, group)
            own = np.concatenate([[k], neighbours(atlas, k, _COVISIBLE, 10)]).astype(np.int32)
            own = own[~np.isin(own, group)]
        self._correct_poses(k, candidate, found, turned)
        with mapping.step():
            join_loop(atlas.points, atlas.keyframes, k, found.point, atlas.scales)
            self.closed += 1  # before the adjustment: the frame that first sees its revision has to see why
        for s in own:
            mapping.fuse_into(int(s), old_points)
        mapping.adjust_all(k)
        mapping.pay(k)
        return Correction(jump_m, jump_rad)

    def _correct_poses(self, k: int, candidate: int, found: Tracked, turned: F64) -> None:
        """Spread the loop's error over all keyframes; each point moves with the keyframe that saw it first."""
        atlas, mapping = self.atlas, self.mapping
        with mapping.step():
            turn = mapping.turn_since(turned)
            found_R = found.R if turn is None else found.R @ turn.T
            turned = mapping.turned
            kf, slots = atlas.keyframes, atlas.slots
            index = np.full(len(kf.n), -1, np.int32)
            index[slots] = np.arange(len(slots))
            R, t = kf.R[slots].copy(), kf.t[slots].copy()
            free = kf.serial[slots] != 0
        edges = self._edges(slots, index, R, t, (k, candidate, replace(found, R=found_R)))
        if free.all():
            free[0] = False
        optimise(R, t, edges, free)
        with mapping.step():
            turn = mapping.turn_since(turned)
            R = R if turn is None else R @ turn.T
            slots, R, t = self._with_newer(slots, R, t)
            kf = atlas.keyframes
            index = np.full(len(kf.n), -1, np.int32)
            index[slots] = np.arange(len(slots))
            move_points(atlas.points, kf, index, R, t)
            kf.R[slots], kf.t[slots] = R, t
            mapping.revision += 1
            self.closed += 1

    def _with_newer(self, slots: I32, R: F64, t: F64) -> tuple[I32, F64, F64]:
        """Add the keyframes made while the graph was optimised: each moves with its best neighbour among ``slots``."""
        kf = self.atlas.keyframes
        for s in self.atlas.slots[~np.isin(self.atlas.slots, slots)]:
            near = [int(n) for n in neighbours(self.atlas, int(s), 1, 30) if n in slots]
            n = int(np.flatnonzero(slots == (near[0] if near else slots[-1]))[0])
            moves = pose(kf.R[s], kf.t[s]) @ inverse(pose(kf.R[slots[n]], kf.t[slots[n]])) @ pose(R[n], t[n])
            slots = np.append(slots, s)
            R, t = np.concatenate([R, moves[None, :3, :3]]), np.concatenate([t, moves[None, :3, 3]])
        return slots, R, t

    def _edges(self, slots: I32, index: I32, R: F64, t: F64, loop: tuple[int, int, Tracked]) -> Edges:
        """Return the graph's edges: the best covisible pairs as they stand, and the loop."""
        atlas = self.atlas
        pairs: dict[tuple[int, int], float] = {}
        for a, s in enumerate(slots):
            with self.mapping.step():
                counts = shared_counts(atlas.points, atlas.keyframes.point[s], len(atlas.keyframes.n))
                near = neighbours(atlas, int(s), _COVISIBLE, 6)
            for other in near:
                b = int(index[other]) if other < len(index) else -1
                if b >= 0:  # not one of the newest
                    pairs[min(a, b), max(a, b)] = min(float(counts[other]) / 100.0, 2.0)
            if a > 0:
                pairs.setdefault((a - 1, a), 0.1)
        i = np.array([a for a, _ in pairs], np.int32)
        j = np.array([b for _, b in pairs], np.int32)
        k, candidate, found = loop
        c = index[candidate]
        R_i, t_i = np.concatenate([R[i], found.R[None]]), np.concatenate([t[i], found.t[None]])
        R_j, t_j = np.concatenate([R[j], R[c][None]]), np.concatenate([t[j], t[c][None]])
        R_ij = np.einsum("nab,ncb->nac", R_i, R_j)
        weight = np.array([*pairs.values(), min(found.inliers / 50.0, 3.0)])
        return Edges(
            np.append(i, index[k]).astype(np.int32), np.append(j, c).astype(np.int32), R_ij,
            t_i - np.einsum("nab,nb->na", R_ij, t_j), weight,
        )  # fmt: skip

    def relocate(self, features: Features) -> Iterator[Tracked]:
        """Find places of a lost frame among all keyframes, the most alike first, each one when it is asked for."""
        kf = self.atlas.keyframes
        scores = self.places.scores(self.places.vocabulary.bag(features.desc))
        order = sorted(scores, key=lambda serial: (-scores[serial], -serial))[:5]
        for serial in order:
            slot = self.atlas.slot_of(serial)
            found = self.place(features, slot) if slot >= 0 and kf.n[slot] > 0 else None
            if found is not None and found.inliers >= _MIN_INLIERS:
                yield found


def settles(found: Tracked) -> bool:
    """Return whether a keyframe found in another part of the map tells where it stands.

    What lies beyond the depth camera's range tells the direction alone: a place by such points is the candidate's own.
    """
    return found.inliers >= max(_MIN_INLIERS, _FOUND_LEAST * found.expected) and told_by_close(found)


@njit(cache=True, nogil=True)
def move_points(points: Points, kf: Keyframes, index: I32, R: F64, t: F64) -> None:
    """Move each point rigidly with its first keyframe, whose pose becomes ``R``, ``t`` at ``index`` of its slot."""
    for p in range(len(points.n)):
        if points.n[p] == 0:
            continue
        k = points.frame[p, 0]
        n = index[k]
        X = points.pos[p]
        c = np.empty(3)
        for r in range(3):
            c[r] = kf.R[k, r, 0] * X[0] + kf.R[k, r, 1] * X[1] + kf.R[k, r, 2] * X[2] + kf.t[k, r] - t[n, r]
        for r in range(3):
            points.pos[p, r] = R[n, 0, r] * c[0] + R[n, 1, r] * c[1] + R[n, 2, r] * c[2]


@njit(cache=True, nogil=True)
def join_loop(points: Points, kf: Keyframes, k: int, point: I32, scales: F64) -> None:
    """Give keyframe ``k`` the old points ``point`` (N,) that it was found to see; its own in their place are merged."""
    for i in range(len(point)):
        p, q = point[i], kf.point[k, i]
        if p < 0 or p == q or points.n[p] == 0:
            continue
        if q >= 0:
            merge(points, kf, p, q, scales)
        elif observe(points, kf, p, k, i):
            describe(points, kf, p, scales)
