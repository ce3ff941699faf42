"""The live guard's eyes: what stands in the way now, in the depth image, mapped or not. Pure.

The image is thinned to a few thousand rays. What lies at the aircraft's height is an obstacle; how far each direction
is free at that height is the fan. It sees forward only: what is beside and behind is remembered (space.py) or unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.geometry import Matrix

_THIN = 8
_ENOUGH_RAYS = 6
"""Fewer rays than this are noise or a twig: at 2 m they cover about 5 by 5 cm each, at 0.8 m 1.3 by 1.3."""
BAND_M = 0.25
"""Half height of what counts as the aircraft's height, seen from the camera."""
TRUSTED_M = 4.0
"""A direction that shows nothing is free so far and no farther: thin things fade beyond."""
_SEEING_SHARE = 0.05
"""Least share of the rays below the horizon that must meet something, or the direction is blinded and shows nothing."""
_HITS = 3
"""So many rays in three neighbouring columns make a surface."""
_SURFACE_M = 0.10
_BESIDE, _EDGE_SHARE = 3, 0.06
"""Pixels to either side, and the share of the depth by which they may differ on one surface."""


@dataclass(frozen=True, slots=True)
class Fan:
    """How far the directions of a view are free at the aircraft's height: azimuths in map and metres, both (N,)."""

    azimuth_rad: Matrix
    free_m: Matrix


@dataclass(frozen=True, slots=True)
class View:
    """Surface points (N, 3) relative to the camera, axes of map, metres; at ``stamp_ns``."""

    stamp_ns: int
    points_m: Matrix
    fan: Fan | None = None
    position_m: Matrix = field(default_factory=lambda: np.zeros(3))
    """Where the camera was (3,), in the map of ``map_key``."""
    solid: NDArray[np.bool_] | None = None
    """Which of the points (N,) lie on a surface, not on the edge of one: a stereo camera strews points behind edges.
    None: all of them. The sweep takes all, what is remembered takes the solid ones."""
    map_key: tuple[str, int] | None = None
    """Map and reset counter of the pose used; None where no pose was known: then it is good for the sweep only."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """The box that is swept: half width and half height in metres, and how near to the axis the target may be."""

    half_width_m: float
    half_height_m: float
    target_radius_m: float


def look(
    depth: NDArray[np.uint16], intrinsics: Intrinsics, T_map_camera: Matrix, stamp_ns: int,
    map_key: tuple[str, int] | None = None,
) -> View:  # fmt: skip
    """Return what a raw depth image (H, W) shows; pixels without data give no points."""
    thin = depth[_THIN // 2 :: _THIN, _THIN // 2 :: _THIN].astype(float) / intrinsics.depth_scale
    rows, columns = thin.shape
    x = (np.arange(columns) * _THIN + _THIN // 2 - intrinsics.cx) / intrinsics.fx
    y = (np.arange(rows) * _THIN + _THIN // 2 - intrinsics.cy) / intrinsics.fy
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1) @ T_map_camera[:3, :3].T
    points = rays * thin[..., None]
    seen = thin > 0.0
    fan = fan_of(rays, points, seen)
    return View(stamp_ns, points[seen], fan, T_map_camera[:3, 3].copy(), _solid(depth)[seen], map_key)


def _solid(depth: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Return for each thinned ray whether the pixels beside it are at about its depth."""
    rows = depth[_THIN // 2 :: _THIN].astype(np.float32)
    middle = rows[:, _THIN // 2 :: _THIN]
    left, right = rows[:, _THIN // 2 - _BESIDE :: _THIN], rows[:, _THIN // 2 + _BESIDE :: _THIN]
    width = middle.shape[1]
    out = np.ones(middle.shape, dtype=bool)
    for beside in (left[:, :width], right[:, :width]):
        out &= np.abs(beside - middle) < _EDGE_SHARE * middle
    return out


def fan_of(rays: Matrix, points: Matrix, seen: NDArray[np.bool_]) -> Fan:
    """Return how far each column is free; ``rays`` and ``points`` (H, W, 3) relative to the camera in map's axes."""
    middle = rays[rays.shape[0] // 2]
    azimuth = np.arctan2(middle[:, 1], middle[:, 0])
    ranges = np.hypot(points[..., 0], points[..., 1])
    band = seen & (np.abs(points[..., 2]) < BAND_M)
    hits = np.where(band, ranges, np.inf)
    beside = np.concatenate([np.roll(hits, 1, axis=1), hits, np.roll(hits, -1, axis=1)], axis=0)
    beside[: hits.shape[0], 0] = np.inf
    beside[-hits.shape[0] :, -1] = np.inf
    hit = np.partition(beside, _HITS - 1, axis=0)[_HITS - 1]
    down = rays[..., 2] < 0.0
    meets = (seen & down).sum(axis=0) / np.maximum(down.sum(axis=0), 1)
    seeing = (meets >= _SEEING_SHARE) | np.isfinite(hit)
    return Fan(azimuth, np.where(seeing, np.clip(hit - _SURFACE_M, 0.0, TRUSTED_M), 0.0))


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
