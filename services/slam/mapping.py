"""Local mapping: what happens to the map when a keyframe joins it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.slam import GraphReason
from services.common.geometry import orthonormal
from services.common.process import give_back_memory
from services.slam.atlas import Atlas, neighbours
from services.slam.bundle import Problem, adjust, adjust_large, build, chi_squares, disparity_residuals
from services.slam.camera import CameraModel
from services.slam.config import SlamConfig
from services.slam.depth_noise import DepthNoise
from services.slam.far import FarPrior
from services.slam.features import Features
from services.slam.links import create_points, points_of, shared_counts
from services.slam.refine import gate
from services.slam.runaway import moved_m, ran_away, span_m
from services.slam.thinning import Thinning
from services.slam.tidy import cull_recent, describe_all, drop_outliers, fuse
from services.slam.worker import Crew

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_COMPILED_KEYFRAMES = 24
"""Above this the cameras' system is large enough to pay for LAPACK."""
_TRIES = 3
"""Of a large adjustment that keyframes cut short: each goes on where the last one stopped. On a walk keyframes never cease, and trying
for ever took half a core (6,000 frames: 1.28 cores); when the camera rests it is done in any case."""

_MISFIT = 25.0
"""Five standard deviations' limits: observations beyond are forgotten where an adjustment ran away."""


@dataclass(frozen=True, slots=True)
class Part:
    """A copy of a part of the map, to be adjusted while the map lives on."""

    problem: Problem
    ids: I32
    """The points of the problem."""
    slots: I32
    """The keyframes of the problem, the first ``free`` of them to be moved."""
    free: int
    turned: F64
    """``Mapping.turned`` when the copy was made."""


class Mapping:
    """Keeps the map consistent and small; not aware of frames between keyframes."""

    def __init__(self, atlas: Atlas, camera: CameraModel, config: SlamConfig, crew: Crew, noise: DepthNoise
    ) -> None:  # fmt: skip
        self.atlas = atlas
        self.camera = camera
        self.config = config
        self.far = FarPrior(config.far_m, config.far_sigma_inverse_m)
        self.depth_noise = noise
        self.step = crew.step
        self._crew = crew
        self.revision = 0
        """Up by one whenever poses of keyframes were corrected."""
        self.why: GraphReason = "local_ba"
        self.refused = 0
        """Adjustments that ran away and were not taken over; and in words, the last one."""
        self.refused_last = ""
        self.owed = 0
        """Tries that a large adjustment has left that was put off or cut short."""
        self.turns = 0
        """Up by one whenever the whole map was turned."""
        self.turned: F64 = np.eye(3)
        """All its turns so far, (3, 3), one new array for each: what a job computed before a turn is turned after it."""
        self.thinning = Thinning(atlas, crew)
        self._recent = np.zeros((0, 2), np.int32)

    def hurried(self) -> bool:
        """Return whether the next keyframe waits already: what only refines is then left out or cut short."""
        return self._crew.waiting > 0

    def insert(self, features: Features, R: F64, t: F64, point: I32) -> int:
        """Add a keyframe with its matches and make points of its new features; return its slot. ``settle`` it next."""
        k = self.atlas.add_keyframe(features, R, t, point)
        self._create(k)
        return k

    def join(self, k: int, near: I32) -> None:
        """Have keyframe ``k`` see what keyframes ``near`` see, and make points of its other features."""
        self.fuse_into(k, points_of(self.atlas.points, self.atlas.keyframes, near))
        self._create(k)
        describe_all(self.atlas.points, self.atlas.keyframes, k, self.atlas.scales)

    def settle(self, k: int) -> None:
        """Tidy the map around the new keyframe ``k``."""
        atlas = self.atlas
        with self.step():
            now = int(atlas.keyframes.serial[k])
            self._recent = cull_recent(atlas.points, atlas.keyframes, self._recent, now)
        self._fuse(k)
        if not self.hurried():
            self.adjust_window(k)
        with self.step():
            self.far.learn(atlas.points, atlas.keyframes, self.camera.focal)
        self.thinning.cull_about(k)
        self.thinning.cull_behind()
        self.pay(k)

    def owe(self) -> None:
        """Ask for a large adjustment when there is time."""
        self.owed = _TRIES

    def pay(self, k: int) -> None:
        """Do the large adjustment that is owed, unless keyframes wait: then the next one asks again."""
        if not self.owed or self.hurried():
            return
        left, self.owed = self.owed - 1, 0
        self.adjust_all(k)
        if self.owed:  # cut short again
            self.owed = left

    def _create(self, k: int) -> None:
        atlas, config = self.atlas, self.config
        slots = atlas.reserve_points(int(atlas.keyframes.n[k]))
        made = create_points(
            atlas.points,
            atlas.keyframes,
            k,
            slots,
            self.camera.array,
            config.min_depth_m,
            config.max_depth_m,
            self.far.distance_m,
            atlas.scales,
        )
        born = np.full(made, atlas.newest_serial, np.int32)
        self._recent = np.concatenate([self._recent, np.stack([slots[:made], born], axis=1)])

    def _fuse(self, k: int) -> None:
        atlas = self.atlas
        with self.step():
            near = neighbours(atlas, k, 10, 10)
            own = points_of(atlas.points, atlas.keyframes, np.array([k], np.int32))
        for other in near:
            self.fuse_into(int(other), own)
        with self.step():
            theirs = points_of(atlas.points, atlas.keyframes, near)
        self.fuse_into(k, theirs)
        with self.step():
            describe_all(atlas.points, atlas.keyframes, k, atlas.scales)

    def fuse_into(self, k: int, ids: I32) -> int:
        """Find points ``ids`` among the features of keyframe ``k``; return how many were joined."""
        atlas, camera = self.atlas, self.camera
        with self.step():
            return fuse(
                atlas.points, atlas.keyframes, k, ids, camera.array, camera.variance, atlas.scales,
                camera.cols, camera.width, camera.height,
            )  # fmt: skip

    def adjust_window(self, k: int) -> None:
        """Bundle adjustment of keyframe ``k``, its neighbours and all they see; observers outside hold still."""
        with self.step():
            near = neighbours(self.atlas, k, 15, self.config.window_keyframes - 1)
            window = np.concatenate([[k], near])
            window = window[self.atlas.keyframes.serial[window] != 0].astype(np.int32)
            part = self._about(window, 2 * self.config.window_keyframes)
        self._adjust(part, 5, 5, "local_ba")

    def adjust_all(self, about: int | None = None, most: int | None = None) -> None:
        """Bundle adjustment of every keyframe but the first, and every point; in a large map of those about ``about``.

        ``most``: keyframes above which a map is large, where it is not as configured.
        """
        most = self.config.full_keyframes if most is None else most
        with self.step():
            slots = self.atlas.slots
            if len(slots) > most:
                window = self._nearest(int(slots[-1]) if about is None else about, most)
                part = self._about(window, 2 * most)
            else:
                part = self._part(points_of(self.atlas.points, self.atlas.keyframes, slots), slots[1:], slots[:1])
        self._adjust(part, 10, 10, "full_ba")

    def _nearest(self, k: int, most: int) -> I32:
        """Return up to ``most`` keyframes, ``k`` first, then its neighbours, theirs, and so on; not the map's first."""
        found, begin = {k: None}, 0
        while begin < len(found) < most:
            ring = list(found)[begin:]
            begin = len(found)
            for s in ring:
                found |= {int(x): None for x in neighbours(self.atlas, s, 15, 10)}
        chosen = np.array(list(found), np.int32)
        return chosen[self.atlas.keyframes.serial[chosen] != 0][:most]

    def _about(self, window: I32, most_fixed: int) -> Part | None:
        """Return keyframes ``window`` and all they see; the best observers outside hold still."""
        atlas = self.atlas
        kf = atlas.keyframes
        ids = points_of(atlas.points, kf, window)
        counts = shared_counts(atlas.points, ids, len(kf.n))
        counts[window] = 0
        order = np.lexsort((kf.serial, -counts))
        fixed = order[counts[order] > 0][:most_fixed].astype(np.int32)
        if not len(fixed):  # nobody outside sees any of it: one of its own holds it where it is
            window, fixed = window[:-1], window[-1:]
        return self._part(ids, window, fixed)

    def _part(self, ids: I32, free: I32, fixed: I32) -> Part | None:
        """Return a copy of a part of the map, None when there is nothing to adjust."""
        if not len(free) or not len(ids):
            return None
        kf, points = self.atlas.keyframes, self.atlas.points
        slots = np.concatenate([free, fixed]).astype(np.int32)
        index = np.full(len(kf.n), -1, np.int32)
        index[slots] = np.arange(len(slots))
        far = self.far.disparity(self.camera.array[4], span_m(kf.R[slots], kf.t[slots]))
        problem = build(points, kf, ids, slots, index, self.camera.variance, far)
        return Part(problem, ids, slots, len(free), self.turned)

    def _adjust(self, part: Part | None, robust_iterations: int, iterations: int, why: GraphReason) -> None:
        """Adjust the copy, apply it, drop the observations that do not fit."""
        if part is None:
            return
        problem, camera = part.problem, self.camera.array
        stood = problem.R.copy(), problem.t.copy(), problem.X.copy()
        for rounds, robust in ((robust_iterations, True), (iterations, False)):
            if part.free <= _COMPILED_KEYFRAMES:
                adjust(problem, camera, part.free, rounds, robust)
            else:
                adjust_large(problem, camera, part.free, rounds, robust, self.hurried)
                if self.hurried():  # what was reached is taken, but not yet fit to say what does not fit
                    problem.use[:] = True
                    self.owe()
                    break
            gate(chi_squares(problem, camera), problem.info, 1.0, problem.use)
        if part.free > _COMPILED_KEYFRAMES:
            give_back_memory()
        if not np.isfinite(problem.X).all() or ran_away(stood[:2], (problem.R, problem.t)):
            self._refuse(part, *stood)
            return
        with self.step():
            measured = self.atlas.points.parallax[part.ids] < 0.0
            self.depth_noise.learn(disparity_residuals(problem, camera, self.depth_noise.least_info, measured))
            self._apply(part)
            self.why = why

    def _refuse(self, part: Part, R: F64, t: F64, X: F64) -> None:
        """Leave the map as it stands after an adjustment that ran away, but forget what does not fit it by far: that led it astray."""
        problem = part.problem
        self.refused_last = (
            f"of {part.free} keyframes one went {moved_m((R, t), (problem.R, problem.t)):.0f} m, {len(part.slots) - part.free} held, "
            f"{len(problem.pose)} observations of {len(X)} points"
        )
        problem.R[:], problem.t[:], problem.X[:] = R, t, X
        gate(chi_squares(problem, self.camera.array), problem.info, _MISFIT, problem.use)
        with self.step():
            points, kf = self.atlas.points, self.atlas.keyframes
            drop_outliers(points, kf, part.ids, part.slots, problem.start, problem.pose, problem.use)
        self.refused += 1

    def keyframe_pose(self, serial: int) -> F64:
        """Return T_map_keyframe (4, 4) of a keyframe that lives, or lived.

        Raises:
            KeyError: for a serial that never was.
        """
        return self.thinning.pose_of(serial)

    def _apply(self, part: Part) -> None:
        """Take over an adjustment. Its points and keyframes are still there: only mapping ends any."""
        points, kf, problem = self.atlas.points, self.atlas.keyframes, part.problem
        free = part.slots[: part.free]
        turn = self.turn_since(part.turned)
        R, X = problem.R[: part.free], problem.X
        kf.R[free], kf.t[free] = R if turn is None else R @ turn.T, problem.t[: part.free]
        points.pos[part.ids] = X if turn is None else X @ turn.T
        drop_outliers(points, kf, part.ids, part.slots, problem.start, problem.pose, problem.use)
        self.revision += 1

    def turn(self, R: F64) -> None:
        """Turn the whole map about its origin: ``R`` (3, 3) takes old map points to new ones."""
        points, kf = self.atlas.points, self.atlas.keyframes
        points.pos[:] = points.pos @ R.T
        points.normal[:] = points.normal @ R.T
        kf.R[:] = kf.R @ R.T
        self.turns += 1
        self.turned = orthonormal(R @ self.turned)

    def turn_since(self, before: F64) -> F64 | None:
        """Return what takes map points of when ``turned`` was ``before`` to now's, (3, 3); None when the map stands."""
        return None if self.turned is before else self.turned @ before.T
