"""Compile or load every kernel of the mapper before it is needed."""

from __future__ import annotations

import numpy as np

from services.common.numba_start import load_numba
from services.mapper.config import MapperConfig


def warm() -> None:
    """Run every kernel on a tiny image."""
    load_numba()
    from schemas.camera import Intrinsics
    from services.mapper.cloud import keyframe_cloud, pixel_rays
    from services.mapper.dense_map import DenseMap
    from services.mapper.ground_model import GroundModel
    from services.mapper.local_submap import LocalSubmap

    intrinsics = Intrinsics(width=16, height=12, fx=20.0, fy=20.0, cx=7.5, cy=5.5)
    cloud = keyframe_cloud(
        np.full((12, 16), 2.0, dtype=np.float32),
        np.zeros((12, 16, 3), dtype=np.uint8),
        pixel_rays(intrinsics),
        MapperConfig(),
    )
    dense = DenseMap(MapperConfig())
    dense.add(0, 0, cloud, np.eye(4))
    shifted = np.eye(4)
    shifted[2, 3] = 1.0
    dense.move({0: shifted})
    model = GroundModel(0.5)
    model.touch(dense.submaps.values())
    model.refresh(dense.submaps)
    local = LocalSubmap(MapperConfig())
    view = local.view(np.full((12, 16), 2.0, dtype=np.float32), pixel_rays(intrinsics), intrinsics)
    local.keep(0, view, dense.submaps)
    local.register(view, np.eye(4), dense.submaps)
