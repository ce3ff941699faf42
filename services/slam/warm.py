"""Compile or load every kernel before the first frame."""

from __future__ import annotations

import time

import numpy as np

from schemas.camera import Intrinsics
from services.common.numba_start import load_numba
from services.slam.bundle import adjust_large
from services.slam.config import SlamConfig
from services.slam.keeper import rejoin, whole_map
from services.slam.shutter import turn_slopes
from services.slam.slam import Slam
from services.slam.worker import Crew, Inline, Job

_CACHED_WITHIN_S = 10.0
"""Kernels that took longer were compiled, not loaded."""
_PERIOD_NS = 66_000_000
_done: set[str] = set()


class _Nobody(Inline):
    """Does no job: tracking alone."""

    def submit(self, job: Job) -> None:
        """Leave it undone."""


def warm() -> None:
    """Track a small moving scene once: that runs every kernel of the normal course. A second call does nothing."""
    warm_tracking()
    warm_mapping()


def warm_beside(crew: Crew) -> None:
    """Load what tracking needs now, and have ``crew`` load the rest before its first job: the first pose waits for neither.

    Where kernels have to be compiled, which takes minutes, everything is waited for.
    """
    begin = time.monotonic()
    warm_tracking()
    if time.monotonic() - begin > _CACHED_WITHIN_S:
        warm_mapping()
    else:
        crew.submit(warm_mapping)


def warm_tracking() -> None:
    """Run the kernels that stand between a frame and its pose."""
    if "tracking" in _done:
        return
    load_numba()
    slam = _played(_Nobody(), 2)
    turn_slopes(np.zeros((1, 2)), np.zeros(1), slam.camera.array)
    _done.add("tracking")


def warm_mapping() -> None:
    """Run the kernels of mapping, of loops and of keeping the map."""
    if "mapping" in _done:
        return
    slam = _played(Inline(), 4)
    _warm_loop(slam)
    _warm_keeping(slam)
    _warm_large(slam)
    slam.polish()
    slam.mapping.thinning.retire(int(slam.atlas.slots[1]))
    slam.final_trajectory()
    _done.add("mapping")


def _played(crew: Crew, frames: int) -> Slam:
    """Return slam after the first frames of a scene that moves sideways, each of them a keyframe."""
    rng = np.random.Generator(np.random.PCG64(1))
    coarse = rng.integers(0, 255, (60, 80), dtype=np.uint8)
    grey = np.kron(coarse, np.ones((4, 4), np.uint8))
    depth_m = np.full(grey.shape, 2.0, np.float32)
    intrinsics = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
    slam = Slam(intrinsics, SlamConfig(features=300, close_tracked_min=1000, close_untracked_max=0), crew=crew)
    for index in range(frames):
        shifted = np.ascontiguousarray(np.roll(grey, 4 * index, axis=1))
        slam.track(index * _PERIOD_NS, shifted, depth_m, depth_after_s=0.001)
    return slam


def _warm_large(slam: Slam) -> None:
    """Adjust a copy of the map as a large one is."""
    part = slam.mapping._about(slam.atlas.slots, 1)  # noqa: SLF001 - a map is large only after minutes
    if part is not None:
        adjust_large(part.problem, slam.camera.array, part.free, 1, robust=True)


def _warm_keeping(slam: Slam) -> None:
    """Gather the map for the disk, and put none of it together."""
    whole = whole_map(slam)
    none = np.zeros(0, np.int32)
    rejoin(slam.atlas.points, slam.atlas.keyframes, none, whole["n"][:0], none, whole["feature"][:0], slam.atlas.scales)


def _warm_loop(slam: Slam) -> None:
    """Close a loop of the scene with itself, and relocate in it."""
    slots = slam.atlas.slots
    features = slam.atlas.features_of(int(slots[-1]))
    list(slam.loops.relocate(features))
    found = slam.loops.place(features, int(slots[0]))
    if found is not None:
        slam.loops.close(int(slots[-1]), int(slots[0]), found, slam.mapping.turned)
