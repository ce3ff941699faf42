"""The finer map after the flight: a second pass over the recording, with the poses as they are known at its end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.trees import Tree
from services.camera.codecs import decode_colour, decode_depth_raw
from services.camera.sources import BadFrame
from services.evaluate.exports import Stamped
from services.fine.config import FineConfig
from services.fine.gather import FineCloud, FineMap
from services.fine.model import Stem
from services.fine.segment import Segments, segment
from services.fine.stems import measure_stem
from services.mapper.cloud import keyframe_cloud, pixel_rays
from services.mapper.config import MapperConfig

_LEAF_SHARE = 0.8
"""A frame's own points are thinned to this share of the fine leaf first: nearer pixels than that are no news."""


@dataclass(frozen=True, slots=True)
class FineResult:
    """What the second pass found."""

    cloud: FineCloud
    segments: Segments
    stems: tuple[Stem, ...]
    unmeasured: tuple[int, ...]
    """Trees of the live list of whose stem too little was seen."""
    frames: int
    left_out: int
    """Points that found no room in memory."""
    seconds: float


def fine_map(
    frames: Iterable[RgbdFrame | BadFrame],
    trajectory: Sequence[Stamped],
    trees: Sequence[Tree],
    config: FineConfig,
    progress: Callable[[int], None] | None = None,
) -> FineResult:
    """Fuse every frame that has a pose, and measure the stems of ``trees``.

    Args:
        frames: the recording again, conditioned as before.
        trajectory: T_map_camera by stamp, final.
        trees: of the live result, in map.
        config: the numbers.
        progress: called after each frame with their number so far.
    """
    begin = time.perf_counter()
    row_of = {stamp_ns: k for k, (stamp_ns, _) in enumerate(trajectory)}
    origins = np.array([T[:3, 3] for _, T in trajectory]).reshape(-1, 3)
    fused, mapper, rays = FineMap(trees, config), _mapper_config(config), None
    count = 0
    for frame in frames:
        row = row_of.get(frame.stamp_ns)
        if row is None or isinstance(frame, BadFrame):
            continue
        rays = pixel_rays(frame.intrinsics) if rays is None else rays
        depth_m = decode_depth_raw(frame).astype(np.float32) / np.float32(frame.intrinsics.depth_scale)
        cloud = keyframe_cloud(depth_m, _rgb(frame), rays, mapper)
        fused.add(cloud.points_m, cloud.rgb, trajectory[row][1], row)
        count += 1
        if progress is not None:
            progress(count)
    cloud_all = fused.cloud()
    stems, unmeasured = [], []
    for tree, seen in fused.stems():
        stem = measure_stem(tree, seen, origins, config)
        if stem is None:
            unmeasured.append(tree.id)
        else:
            stems.append(stem)
    segments = segment(cloud_all.points_m, trees, config)
    return FineResult(
        cloud_all, segments, tuple(stems), tuple(unmeasured), count, fused.left_out, time.perf_counter() - begin
    )  # fmt: skip


def _mapper_config(config: FineConfig) -> MapperConfig:
    """Return the mapper's filters for single frames at the fine leaf."""
    return MapperConfig(
        min_range_m=0.2, max_range_m=config.max_range_m, voxel_m=_LEAF_SHARE * config.voxel_m,
        range_noise_per_m=config.range_noise_per_m,
    )  # fmt: skip


def _rgb(frame: RgbdFrame) -> NDArray[np.uint8] | None:
    if frame.colour_encoding == "none":
        return None
    return np.ascontiguousarray(decode_colour(frame)[..., ::-1])
