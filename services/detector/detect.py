"""Trees from a cloud by slicing: ground, crop, voxels, slices, arcs, lean lines, cylinders, checks.

The steps are section 4 of the reference (Tree Position Detection for Autonomous UAV Navigation, chapter 3) with its
plane, pair projection and hull fit replaced by what measures better on one-sided arcs: docs/decisions/detector.md.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.detector.arcs import fit_slices
from services.detector.band import Band, crop
from services.detector.candidates import Surroundings, judge
from services.detector.config import DetectorConfig
from services.detector.ground import find_ground
from services.detector.model import DetectionResult, Ground, Views
from services.detector.stacks import stack_circles
from services.detector.upright import upright_frame
from services.detector.voxels import slice_clusters


@dataclass(slots=True)
class _Stopwatch:
    last: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.stages[stage] = (now - self.last) * 1e3
        self.last = now


def detect_trees(
    points_m: NDArray[np.floating],
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    views: Views | None = None,
    config: DetectorConfig | None = None,
) -> DetectionResult:
    """Return the trunks in a cloud.

    Args:
        points_m: (N, 3) float32 or float64, any frame, metres; rows that are not finite are skipped and counted.
        up: the vertical in that frame, opposite to gravity.
        views: from where each point was seen; without it (terrestrial scans) residuals are radial.
        config: the numbers; defaults when absent.

    An empty cloud, or one without trunks, gives an empty result.
    """
    config = config or DetectorConfig()
    watch = _Stopwatch()
    points_m = np.ascontiguousarray(points_m).reshape(-1, 3)
    if points_m.dtype not in (np.dtype(np.float32), np.dtype(np.float64)):
        points_m = points_m.astype(np.float64)
    frame = upright_frame(points_m, up)
    if frame.finite == 0:
        return _empty(points_m, up)
    watch.lap("upright")
    grounded = find_ground(frame, config.ground_cell_m)
    ground = grounded.ground
    watch.lap("ground")
    crop_low = config.crop_low_m if ground.seen else -0.05
    band = crop(frame, grounded, views, crop_low, config.crop_high_m, config.look_high_m)
    watch.lap("crop")
    slices = slice_clusters(frame, band, views, config.layer_m, config.link_m, config.voxel_m)
    watch.lap("clusters")
    circles = fit_slices(slices, frame.low, config)
    watch.lap("arcs")
    span_m = _needed_span_m(band, ground, config)
    min_layers = max(3.0, min(config.min_layers, 0.8 * span_m / slices.layer_m))
    stacks = stack_circles(circles, 0.75 * min_layers, config)
    watch.lap("stacks")
    trunks, rejections = judge(stacks, Surroundings(slices.voxels, band.above_m, views, frame, ground, span_m, config))
    watch.lap("cylinders")
    return DetectionResult(
        tuple(trunks), tuple(rejections), ground, up, frame.finite, len(points_m) - frame.finite, watch.stages
    )


def _empty(points_m: NDArray[np.floating], up: tuple[float, float, float]) -> DetectionResult:
    ground = Ground(0.0, 0.0, 0.5, np.zeros((1, 1, 3)), seen=False, note="no points")
    return DetectionResult((), (), ground, up, 0, len(points_m))


def _needed_span_m(band: Band, ground: Ground, config: DetectorConfig) -> float:
    """Return the height over which a trunk must be seen: less where the whole cloud is a thin slab."""
    if ground.seen or len(band.xyz_m) == 0:
        return config.min_span_m
    extent = band.span_m[1] - band.span_m[0]
    return float(min(config.min_span_m, max(0.2, 0.7 * extent)))
