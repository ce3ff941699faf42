"""What the radio carries of the map: each submap thinned to a few thousand points, for a station's 3D view. Pure."""

from __future__ import annotations

import numpy as np

from schemas.sketch import STEP_M, SubmapSketch
from services.mapper.dense_map import MapSubmap

_REACH = 32_000
"""Steps to either side that an int16 holds, with a margin: 320 m, far beyond any depth image."""


def sketch_of(submap: MapSubmap, map_id: str, *, points: bool, removed: bool = False) -> SubmapSketch:
    """Return the message of a submap, with its points or without.

    The points are drawn in a random order that depends on the submap's number alone: every first part of them is an
    even sample, so whoever has room for fewer takes fewer.
    """
    n = len(submap.points_m) if points and not removed else 0
    order = np.random.default_rng(submap.submap_id).permutation(n)[: SubmapSketch.MAX_POINTS]
    steps = np.clip(np.rint(submap.points_m[order] / STEP_M), -_REACH, _REACH).astype(np.int16)
    colour = submap.rgb[order] if len(submap.rgb) else np.full((len(order), 3), 128, dtype=np.uint8)
    return SubmapSketch(
        map_id=map_id, submap_id=submap.submap_id, version=submap.version, stamp_ns=submap.stamp_ns,
        T_map_submap=submap.T_map_submap.copy(), points_cm=steps, colour=colour, removed=removed,
    )  # fmt: skip
