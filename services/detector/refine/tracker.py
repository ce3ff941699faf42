"""Follows one target through the depth images: chooses it, measures it, filters it, and says when it is lost."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.camera import Intrinsics
from services.detector.refine.agreement import Colour, ColourAgreement
from services.detector.refine.choose import image_place, in_view, nearest_in_view
from services.detector.refine.config import RefinerConfig
from services.detector.refine.consistency import MapConsistency
from services.detector.refine.correction import Correction
from services.detector.refine.kalman import TargetFilter
from services.detector.refine.model import Depth, ExpectedTree, Matrix, Measurement
from services.detector.refine.refine import refine
from services.detector.refine.state import TargetState
from services.detector.refine.view import (
    axis_point,
    bearing_of_column,
    place_in_map,
    pose_offset_covariance,
    project_point,
)

_MAX_DT_S = 1.0
_STALE_POSE_COVARIANCE = np.diag([0.1, 0.1, 0.05, 0.03, 0.03, 0.06]) ** 2
"""Of a pose that is up to ``lost_after_s`` old."""
_MIN_SPEED_DT_NS, _MAX_SPEED_DT_NS = 90_000_000, 250_000_000
_MOVED_M = 0.10
"""A tree that a new list moves by more than this is measured afresh."""


class RefinerTracker:
    """The refiner's memory between frames. Calls come in order of stamps; nothing here knows a clock or a bus."""

    def __init__(self, config: RefinerConfig) -> None:
        self._config = config
        self._trees: dict[int, ExpectedTree] = {}
        self._suitable: set[int] = set()
        self._corrections: dict[int, Correction] = {}
        self._map_id = ""
        self._graph_version = -1
        self._chosen: int | None = None
        self._target: int | None = None
        self._filter: TargetFilter | None = None
        self._place_map_m: Matrix | None = None
        self._stamp_ns = 0
        self._seen_ns = 0
        self._pose: tuple[int, Matrix] | None = None
        self._recent: deque[tuple[int, Matrix]] = deque(maxlen=8)
        self._agreement = ColourAgreement(config.agreement)
        self._consistency = MapConsistency(config.consistency)
        self._intrinsics: Intrinsics | None = None

    @property
    def camera_fault(self) -> str:
        """Return what is wrong with the camera or what is told of it, empty when nothing is known to be."""
        return self._agreement.fault or self._consistency.fault

    @property
    def innovations2(self) -> tuple[float, float, float] | None:
        """Return the filters' last normalised squared innovations (image x, range, radius), None without filters."""
        return self._filter.innovations2 if self._filter else None

    @property
    def map_id(self) -> str:
        """Return the map that the known trees belong to, empty when there is none."""
        return self._map_id

    def set_trees(
        self, trees: Sequence[ExpectedTree], suitable: Sequence[int], map_id: str, graph_version: int
    ) -> None:
        """Take the newest list; another map drops target and corrections, a corrected graph drops corrections."""
        if map_id != self._map_id:
            self.drop(map_id)
        if graph_version != self._graph_version:
            self._corrections = {}
        self._graph_version = graph_version
        new = {tree.id: tree for tree in trees}
        for tree_id in list(self._corrections):
            before, after = self._trees.get(tree_id), new.get(tree_id)
            if not before or not after or math.hypot(after.x_m - before.x_m, after.y_m - before.y_m) > _MOVED_M:
                del self._corrections[tree_id]
            else:
                self._corrections[tree_id] = self._corrections[tree_id].rebased(before, after)
        self._trees, self._suitable = new, set(suitable)
        if self._target not in self._trees:
            self._forget_target()

    def drop(self, map_id: str) -> None:
        """Begin with a new map: nothing known of the old one holds in it."""
        self._trees, self._suitable, self._corrections = {}, set(), {}
        self._map_id, self._chosen, self._pose = map_id, None, None
        self._recent.clear()
        self._consistency.interrupt()
        self._forget_target()

    def pose_jumped(self) -> None:
        """Slam corrected the pose by a jump: places in map from before it say nothing about the next image."""
        self._place_map_m = None
        self._corrections = {}
        self._recent.clear()
        self._consistency.interrupt()

    def choose(self, tree_id: int | None) -> None:
        """Follow this tree; None: the nearest suitable one in view."""
        self._chosen = tree_id

    def corrected(self, tree_id: int) -> ExpectedTree:
        """Return a tree of the list with what the depth images said of it."""
        tree = self._trees[tree_id]
        correction = self._corrections.get(tree_id)
        return correction.applied(tree) if correction else tree

    def step(
        self, stamp_ns: int, depth_m: Depth | None, intrinsics: Intrinsics, T_map_camera: Matrix | None,
        pose_covariance: Matrix | None, reason: str = "", colour: Colour | None = None,
    ) -> TargetState:  # fmt: skip
        """Return what is known of the target after the frame of ``stamp_ns``.

        Args:
            stamp_ns: The frame's.
            depth_m: (H, W) float32 metres, or None for a frame that cannot be used: then the target is predicted.
            intrinsics: Of the depth image.
            T_map_camera: The frame's pose, or None without a trustworthy one: the last pose serves for a moment to
                find the trunk again in the camera's own frame, and no place in the map is given.
            pose_covariance: (6, 6) of the pose.
            reason: Why depth or pose is missing, for the note.
            colour: (H, W, 3) of the frame, where it is at hand: depth that shows another moment is then noticed.
        """
        known_pose = T_map_camera is not None
        self._know_camera(intrinsics)
        T, covariance = self._usable_pose(stamp_ns, T_map_camera, pose_covariance)
        if T is None:
            self._forget_target()
            return TargetState("none", note=reason or "no pose")
        target = self._select(T, intrinsics)
        dt_s = min(max((stamp_ns - self._stamp_ns) * 1e-9, 0.0), _MAX_DT_S)
        self._stamp_ns = stamp_ns
        if target is None:
            return TargetState("none", tree_id=self._target, note=reason)
        self._predict(dt_s, T, intrinsics, known_pose)
        measured = None
        if depth_m is not None:
            measured = self._measure(depth_m, intrinsics, T, covariance, target)
        if measured is not None:
            refusal = self._doubt(measured, target, T if known_pose else None, stamp_ns, intrinsics, colour)
            if refusal:
                measured, reason = None, refusal
        believed = measured is not None and self._take(measured, T, intrinsics, stamp_ns, known_pose)
        return self._state(stamp_ns, measured if believed else None, T, covariance, intrinsics, known_pose, reason)

    def _usable_pose(
        self, stamp_ns: int, T_map_camera: Matrix | None, covariance: Matrix | None
    ) -> tuple[Matrix | None, Matrix | None]:
        if T_map_camera is not None:
            self._pose = (stamp_ns, T_map_camera)
            self._recent.append(self._pose)
            return T_map_camera, covariance
        if self._pose is None or stamp_ns - self._pose[0] > self._config.filter.lost_after_s * 1e9:
            return None, None
        return self._pose[1], _STALE_POSE_COVARIANCE

    def _select(self, T: Matrix, intrinsics: Intrinsics) -> ExpectedTree | None:
        """Choose the target, and return it when it should be in view."""
        far = self._config.max_target_range_m
        target: int | None
        if self._chosen is not None:
            target = self._chosen if self._chosen in self._trees else None
        else:
            trees = [self.corrected(tree_id) for tree_id in sorted(self._suitable) if tree_id in self._trees]
            target = nearest_in_view(trees, T, intrinsics, far, self._target)
        if target != self._target:
            self._forget_target()
            self._target = target
        if target is None:
            return None
        tree = self.corrected(target)
        if in_view(tree, T, intrinsics, far) is None:
            self._filter, self._place_map_m = None, None
            return None
        return tree

    def _know_camera(self, intrinsics: Intrinsics) -> None:
        """Forget what was found about another camera."""
        if intrinsics is self._intrinsics:
            return
        if self._intrinsics is not None and intrinsics != self._intrinsics:
            self._agreement = ColourAgreement(self._config.agreement)
            self._consistency = MapConsistency(self._config.consistency)
        self._intrinsics = intrinsics

    def _doubt(
        self, measured: Measurement, target: ExpectedTree, T: Matrix | None, stamp_ns: int, intrinsics: Intrinsics,
        colour: Colour | None,
    ) -> str:  # fmt: skip
        """Return why the camera is not to be believed in this frame, or nothing."""
        refusal = ""
        if colour is not None:
            speed = self._image_speed(target, stamp_ns, intrinsics) if T is not None else None
            refusal = self._agreement.see(stamp_ns, colour, measured.edges_px, speed)
        if T is not None and not refusal:
            listed = axis_point(self._trees[measured.tree_id], float(T[2, 3]))
            self._consistency.see(stamp_ns, measured.tree_id, listed, T[:2, 3], measured.bearing_rad, measured.range_m)
        return refusal or self._consistency.fault

    def _image_speed(self, tree: ExpectedTree, stamp_ns: int, intrinsics: Intrinsics) -> float | None:
        """Return how fast the camera's motion lately moved the tree in the image, px/s; None when that is not known.

        Over a tenth of a second, as the jitter of two poses in a row says little.
        """
        past = [(t, T) for t, T in self._recent if _MIN_SPEED_DT_NS <= stamp_ns - t < _MAX_SPEED_DT_NS]
        if not past or self._pose is None:
            return None
        then_ns, T_then = past[-1]
        now, then = image_place(tree, self._pose[1], intrinsics), image_place(tree, T_then, intrinsics)
        if now is None or then is None:
            return None
        return (now[0] - then[0]) / ((stamp_ns - then_ns) * 1e-9)

    def _forget_target(self) -> None:
        self._target, self._filter, self._place_map_m, self._seen_ns = None, None, None, 0

    def _predict(self, dt_s: float, T: Matrix, intrinsics: Intrinsics, known_pose: bool) -> None:
        """Move the filters on by the camera's known motion: where the filtered place is in this image."""
        if self._filter is None:
            return
        moved = None
        if known_pose and self._place_map_m is not None:
            offset = self._place_map_m - T[:2, 3]
            x, y, z = (offset @ T[:2, :3]).tolist()
            if z > 0.1:
                column, distance, _ = self._filter.values
                now = project_point(x, y, z, intrinsics)[0]
                moved = (now - column, float(np.hypot(offset[0], offset[1])) - distance)
        self._filter.predict(dt_s, moved, intrinsics.fx)

    def _measure(
        self, depth_m: Depth, intrinsics: Intrinsics, T: Matrix, covariance: Matrix | None, target: ExpectedTree
    ) -> Measurement | None:
        others = [self.corrected(tree_id) for tree_id in self._trees if tree_id != target.id]
        return refine(depth_m, intrinsics, T, covariance, target, others, self._config)

    def _take(self, measured: Measurement, T: Matrix, intrinsics: Intrinsics, stamp_ns: int, known_pose: bool) -> bool:
        """Filter a measurement and correct the map's tree by it; tell whether it was believed."""
        values = (measured.image_x_px, measured.range_m, measured.radius_m)
        C = measured.covariance
        slope = bearing_of_column(measured.image_x_px, T, intrinsics)[1]
        variances = (float(C[0, 0]) * slope**2, float(C[1, 1]), float(C[2, 2]))
        if self._filter is not None and not self._filter.update(values, variances):
            if not self._filter.hopeless:
                return False
            self._filter = None
        if self._filter is None:
            self._filter = TargetFilter(values, variances, self._config.filter)
        self._seen_ns = stamp_ns
        if known_pose:
            tree = self._trees[measured.tree_id]
            correction = self._corrections.get(tree.id) or Correction.none(tree)
            self._corrections[tree.id] = correction.fused(measured, tree)
        return True

    def _state(
        self, stamp_ns: int, measured: Measurement | None, T: Matrix, covariance: Matrix | None,
        intrinsics: Intrinsics, known_pose: bool, reason: str,
    ) -> TargetState:  # fmt: skip
        fresh = stamp_ns - self._seen_ns <= self._config.filter.lost_after_s * 1e9
        if self._filter is None or (measured is None and not fresh):
            self._filter, self._place_map_m = None, None
            return TargetState("lost", self._target, note=reason or "expected in view, not seen")
        x, distance, radius = self._filter.values
        var_x, var_range, var_radius = self._filter.variances
        bearing, slope = bearing_of_column(x, T, intrinsics)
        sigma_bearing = math.sqrt(var_x) / slope
        state = TargetState(
            "tracking", self._target, measured is not None, bearing, distance, radius, x, sigma_bearing,
            math.sqrt(var_range), math.sqrt(var_radius), note=reason,
            raw_image_x_px=measured.image_x_px if measured else None,
            raw_range_m=measured.range_m if measured else None, raw_radius_m=measured.radius_m if measured else None,
        )  # fmt: skip
        return self._placed(state, T, covariance) if known_pose else state

    def _placed(self, state: TargetState, T: Matrix, covariance: Matrix | None) -> TargetState:
        """Return the state with its place in map, from the filtered bearing and range and the pose."""
        bearing, distance = state.bearing_rad or 0.0, state.range_m or 0.0
        variances = ((state.sigma_bearing_rad or 0.0) ** 2, (state.sigma_range_m or 0.0) ** 2)
        place, own = place_in_map(bearing, distance, variances, T)
        self._place_map_m = place
        if covariance is not None:
            own = own + pose_offset_covariance(place - T[:2, 3], covariance)
        return replace(
            state, position_map_m=(float(place[0]), float(place[1])),
            covariance_map_m2=(float(own[0, 0]), float(own[0, 1]), float(own[1, 1])),
        )  # fmt: skip
