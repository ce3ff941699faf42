"""Compiles or loads every kernel, so that the first frame is as fast as the others."""

from __future__ import annotations

import numpy as np

from schemas.camera import Intrinsics
from services.common.numba_start import load_numba
from services.detector.refine import kernels_colour
from services.detector.refine.agreement import ColourAgreement
from services.detector.refine.config import RefinerConfig
from services.detector.refine.kalman import TargetFilter
from services.detector.refine.model import ExpectedTree
from services.detector.refine.refine import refine

_LEVEL = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]])


def warm() -> None:
    """Run the refiner once on a small made-up trunk, and the filters once."""
    load_numba()
    intrinsics = Intrinsics(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
    depth = np.zeros((48, 64), np.float32)
    x = (np.arange(64) - 31.5) / 50.0
    column = 2.0 - np.sqrt(np.maximum(0.2**2 - (2.0 * x) ** 2, 0.0))
    depth[:, np.abs(x) < 0.095] = column[np.abs(x) < 0.095]
    tree = ExpectedTree(0, 2.0, 0.0, 0.0, (0.0, 0.0, 1.0), 0.2, 0.05, 0.01)
    refine(depth, intrinsics, _LEVEL, np.eye(6) * 1e-4, tree, [], RefinerConfig())
    agreement = ColourAgreement(RefinerConfig().agreement)
    edges = np.array([[row, 20, 40] for row in range(48)], dtype=np.int64)
    agreement.see(0, np.frombuffer(bytes(48 * 64 * 3), np.uint8).reshape(48, 64, 3), edges, 0.0)
    kernels_colour.best_offset(np.ones((2, 97)), 6, np.empty(3))
    filters = TargetFilter((0.0, 2.0, 0.1), (1.0, 1e-4, 1e-4), RefinerConfig().filter)
    filters.predict(0.1, (0.0, 0.0), 50.0)
    filters.update((0.0, 2.0, 0.1), (1.0, 1e-4, 1e-4))
