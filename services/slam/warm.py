"""Compile or load every kernel before the first frame."""

from __future__ import annotations

import numpy as np

from schemas.camera import Intrinsics
from services.common.numba_start import load_numba
from services.slam.bundle import adjust_large
from services.slam.config import SlamConfig
from services.slam.keeper import rejoin, whole_map
from services.slam.shutter import turn_slopes
from services.slam.slam import Slam

_done = False


def warm() -> None:
    """Track a small moving scene once: that runs every kernel of the normal course. A second call does nothing."""
    global _done
    if _done:
        return
    load_numba()
    rng = np.random.Generator(np.random.PCG64(1))
    coarse = rng.integers(0, 255, (60, 80), dtype=np.uint8)
    grey = np.kron(coarse, np.ones((4, 4), np.uint8))
    depth_m = np.full(grey.shape, 2.0, np.float32)
    intrinsics = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5)
    slam = Slam(intrinsics, SlamConfig(features=300, close_tracked_min=1000, close_untracked_max=0))
    for index in range(4):
        shift = 4 * index
        slam.track(index, np.ascontiguousarray(np.roll(grey, shift, axis=1)), depth_m)
    _warm_loop(slam)
    _warm_keeping(slam)
    _warm_large(slam)
    turn_slopes(np.zeros((1, 2)), np.zeros(1), slam.camera.array)
    slam.polish()
    slam.mapping.retire(int(slam.atlas.slots[1]))
    slam.final_trajectory()
    _done = True


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
    slam.loops.relocate(features)
    found = slam.loops.place(features, int(slots[0]))
    if found is not None:
        slam.loops.close(int(slots[-1]), int(slots[0]), found, slam.mapping.turned)
