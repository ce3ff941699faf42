"""Compile or load every kernel of the detector before it is needed."""

from __future__ import annotations

import numpy as np

from services.common.numba_start import load_numba


def warm() -> None:
    """Run every kernel on a small cloud, for both kinds of float, with and without views."""
    load_numba()
    from services.detector.checks import warm_checks
    from services.detector.detect import detect_trees
    from services.detector.model import Views

    a, h = (v.ravel() for v in np.meshgrid(np.linspace(0.0, 6.28, 60), np.linspace(0.0, 2.4, 60)))
    stem = np.stack([0.1 * np.cos(a), 0.1 * np.sin(a), h], axis=1)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-1.0, 1.0, 41), np.linspace(-1.0, 1.0, 41)))
    cloud = np.concatenate([stem, np.stack([x, y, np.zeros_like(x)], axis=1)])
    origins = np.tile(np.array([[3.0, 0.0, 1.5]]), (len(cloud), 1))
    warm_checks()
    for kind in (np.float32, np.float64):
        detect_trees(cloud.astype(kind))
        detect_trees(cloud.astype(kind), views=Views.of_points(origins))
