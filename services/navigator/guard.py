"""The live guard: what stands in the way now, in the depth image, mapped or not. Pure.

The image is thinned to a few thousand rays; a box as wide and as high as the aircraft is swept along the direction of
flight. It sees forward only: sideways and backward the map has to do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import Matrix

_THIN = 8
_ENOUGH_RAYS = 6
"""Fewer rays than this are noise or a twig: at 2 m they cover about 5 by 5 cm each, at 0.8 m 1.3 by 1.3."""


@dataclass(frozen=True, slots=True)
class View:
    """Surface points (N, 3) relative to the camera, axes of map, metres; at ``stamp_ns``."""

    stamp_ns: int
    points_m: Matrix


@dataclass(frozen=True, slots=True)
class Sweep:
    """The box that is swept: half width and half height in metres, and how near to the axis the target may be."""

    half_width_m: float
    half_height_m: float
    target_radius_m: float


def look(depth: NDArray[np.uint16], intrinsics: Intrinsics, R_map_camera: Matrix, stamp_ns: int) -> View:
    """Return the surface points of a raw depth image (H, W); pixels without data give none."""
    thin = depth[_THIN // 2 :: _THIN, _THIN // 2 :: _THIN].astype(float) / intrinsics.depth_scale
    v, u = np.nonzero(thin)
    z = thin[v, u]
    x = (u * _THIN + _THIN // 2 - intrinsics.cx) / intrinsics.fx * z
    y = (v * _THIN + _THIN // 2 - intrinsics.cy) / intrinsics.fy * z
    return View(stamp_ns, np.stack([x, y, z], axis=1) @ R_map_camera.T)


def free_way_m(view: View, direction: Matrix, target_m: Matrix | None, sweep: Sweep) -> float:
    """Return how far the box may be swept along ``direction`` (2,) before it meets something, inf when it is free.

    ``target_m`` (2,): the target's axis relative to the camera; surfaces near it are the trunk itself.
    """
    p = view.points_m
    d = direction / np.linalg.norm(direction)
    along = p[:, 0] * d[0] + p[:, 1] * d[1]
    aside = p[:, 1] * d[0] - p[:, 0] * d[1]
    inside = (along > 0.0) & (np.abs(aside) < sweep.half_width_m) & (np.abs(p[:, 2]) < sweep.half_height_m)
    if target_m is not None:
        inside &= np.hypot(p[:, 0] - target_m[0], p[:, 1] - target_m[1]) > sweep.target_radius_m
    hits = along[inside]
    if len(hits) < _ENOUGH_RAYS:
        return float("inf")
    return float(np.partition(hits, _ENOUGH_RAYS - 1)[_ENOUGH_RAYS - 1])
