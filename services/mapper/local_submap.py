"""The views that a new keyframe is registered against: those of the keyframes around it, as the map has them now."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.mapper.config import MapperConfig
from services.mapper.dense_map import MapSubmap
from services.mapper.register import NOT_REGISTERED, Placed, RangeView, Registration, range_view, register

Matrix = NDArray[np.float64]

_REFERENCES = 6
_ALIKE = 0.6
_PER_METRE = 0.3
"""Two views are as alike as the cosine between their axes less so much per metre between them."""
_NEWEST = 8
"""Views that stay whatever they show."""


def likeness(a: Matrix, b: Matrix) -> float:
    """Return how much two camera poses see of the same: 1 for the same, below ``_ALIKE`` too little."""
    return float(a[:3, 2] @ b[:3, 2]) - _PER_METRE * float(np.linalg.norm(a[:3, 3] - b[:3, 3]))


class LocalSubmap:
    """Keeps a bounded number of reduced views, the most redundant going first, and registers new ones against them."""

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self._views: dict[int, RangeView] = {}

    def clear(self) -> None:
        """Begin a new map."""
        self._views = {}

    def view(self, depth_m: NDArray[np.float32], rays: NDArray[np.float32], i: Intrinsics) -> RangeView:
        """Return the reduced view of a depth image."""
        c = self._config
        in_range = np.where((depth_m >= c.min_range_m) & (depth_m <= c.max_range_m), depth_m, np.float32(0.0))
        return range_view(in_range, rays, (i.fx, i.fy, i.cx, i.cy), c.range_noise_per_m)

    def register(self, view: RangeView, T_map_camera: Matrix, submaps: Mapping[int, MapSubmap]) -> Registration:
        """Register a view against those around it."""
        scored = [
            (likeness(T_map_camera, submaps[k].T_map_submap), k) for k in self._views if k in submaps
        ]  # fmt: skip
        best = sorted((s for s in scored if s[0] > _ALIKE), key=lambda s: (-s[0], s[1]))[:_REFERENCES]
        if not best:
            return NOT_REGISTERED
        c = self._config
        sigma = np.array([c.registration_sigma_m] * 3 + [c.registration_sigma_rad] * 3)
        references = [Placed(self._views[k], submaps[k].T_map_submap) for _, k in best]
        return register(view, T_map_camera, references, sigma, c.range_noise_per_m)

    def keep(self, keyframe_id: int, view: RangeView, submaps: Mapping[int, MapSubmap]) -> None:
        """Take up a view; beyond the bound the one goes that another is most like."""
        self._views[keyframe_id] = view
        self._views = {k: v for k, v in self._views.items() if k in submaps}
        if len(self._views) <= self._config.registration_views:
            return
        ids = list(self._views)
        settled = ids[:-_NEWEST]
        most = max(
            (max(likeness(submaps[k].T_map_submap, submaps[o].T_map_submap) for o in ids if o != k), -k)
            for k in settled
        )  # fmt: skip
        del self._views[-most[1]]
