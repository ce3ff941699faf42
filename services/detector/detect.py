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
from services.detector.checks import axis_at, base_point, prolonged_top_m, shape_fault, space_above_was_seen
from services.detector.config import DetectorConfig
from services.detector.cylinders import Cylinder, fit_cylinder
from services.detector.ground import find_ground
from services.detector.model import DetectionResult, Floats, Ground, Rejection, Trunk, Views
from services.detector.stacks import Stack, stack_circles
from services.detector.upright import Upright, upright_frame
from services.detector.voxels import Voxels, clusters_per_layer, crop_to_voxels, plan_spacing_m

BREAST_HEIGHT_M = 1.3


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
    ground = find_ground(points_m, frame, config.ground_cell_m)
    watch.lap("ground")
    crop_low = config.crop_low_m if ground.seen else -0.05
    voxels = crop_to_voxels(points_m, views, frame, ground, crop_low, config.crop_high_m, config.voxel_m)
    above = crop_to_voxels(points_m, None, frame, ground, config.crop_high_m, config.look_high_m, 0.03)
    watch.lap("crop")
    spacing = plan_spacing_m(voxels, frame.low, config.layer_m)
    layer_m = float(np.clip(4.0 * spacing, config.layer_m, 2.5 * config.layer_m))
    link_m = float(np.clip(2.5 * spacing, config.link_m, 0.08))
    order, begin = clusters_per_layer(voxels, frame.low, layer_m, link_m)
    watch.lap("clusters")
    circles = fit_slices(voxels, order, begin, frame.low, spacing, layer_m, config)
    watch.lap("arcs")
    span_m = _needed_span_m(voxels, ground, config)
    min_layers = max(3.0, min(config.min_layers, 0.8 * span_m / layer_m))
    stacks = stack_circles(circles, 0.75 * min_layers, config)
    watch.lap("stacks")
    trunks, rejections = _judge(stacks, voxels, above, views, frame, ground, span_m, config)
    watch.lap("cylinders")
    return DetectionResult(
        tuple(trunks), tuple(rejections), ground, up, frame.finite, len(points_m) - frame.finite, watch.stages
    )


def _empty(points_m: NDArray[np.floating], up: tuple[float, float, float]) -> DetectionResult:
    ground = Ground(0.0, 0.0, 0.5, np.zeros((1, 1, 3)), seen=False, note="no points")
    return DetectionResult((), (), ground, up, 0, len(points_m))


def _needed_span_m(voxels: Voxels, ground: Ground, config: DetectorConfig) -> float:
    """Return the height over which a trunk must be seen: less where the whole cloud is a thin slab."""
    if ground.seen or len(voxels.height_m) == 0:
        return config.min_span_m
    extent = float(np.ptp(voxels.height_m))
    return float(min(config.min_span_m, max(0.2, 0.7 * extent)))


@dataclass(frozen=True, slots=True)
class _Candidate:
    cylinder: Cylinder
    base: Floats
    low_m: float
    high_m: float
    top_m: float


def _judge(
    stacks: list[Stack], voxels: Voxels, above: Voxels, views: Views | None, frame: Upright, ground: Ground,
    span_m: float, config: DetectorConfig,
) -> tuple[list[Trunk], list[Rejection]]:  # fmt: skip
    kept: list[_Candidate] = []
    rejections: list[Rejection] = []
    for stack in stacks:
        cylinder = fit_cylinder(voxels, stack, config)
        if cylinder is None:
            rejections.append(
                _rejection(stack.at_m, stack.radius_m, stack.layers, "too few points for a cylinder", frame)
            )
            continue
        base = base_point(cylinder, ground)
        low, high = cylinder.z_low_m - base[2], cylinder.z_high_m - base[2]
        reason = shape_fault(cylinder, low, high, span_m, config)
        top = high
        if not reason:
            z_top = prolonged_top_m(cylinder, above, base[2] + config.look_high_m)
            top = z_top - base[2]
            reason = _post_fault(cylinder, top, z_top, views, frame, above, config)
        if not reason:
            reason = _twin_fault(cylinder, kept)
        if reason:
            rejections.append(_rejection(base, cylinder.radius_m, stack.layers, reason, frame))
        else:
            kept.append(_Candidate(cylinder, base, low, high, top))
    trunks = [_as_trunk(c, frame, config) for c in kept]
    trunks.sort(key=lambda t: (np.hypot(t.base_m[0], t.base_m[1]), t.base_m))
    return trunks, rejections


def _rejection(at: Floats, radius: float, layers: int, reason: str, frame: Upright) -> Rejection:
    x, y, z = (float(v) for v in frame.to_input(at))
    return Rejection(x, y, z, radius, layers, reason)


def _post_fault(
    cylinder: Cylinder,
    top_m: float,
    z_top: float,
    views: Views | None,
    frame: Upright,
    above: Voxels,
    config: DetectorConfig,
) -> str:
    if top_m >= config.post_top_m:
        return ""
    free = axis_at(cylinder, z_top + 0.35)
    if not space_above_was_seen(free, views, frame, above, z_top):
        return ""
    return f"ends {top_m:.1f} m above ground with free space seen above it: a post"


def _twin_fault(cylinder: Cylinder, kept: list[_Candidate]) -> str:
    """Tell when the candidate shares its place with a better one."""
    for other in kept:
        z = cylinder.at_m[2]
        d = float(np.linalg.norm(axis_at(other.cylinder, z)[:2] - cylinder.at_m[:2]))
        if d < max(other.cylinder.radius_m, cylinder.radius_m) + 0.3 * min(other.cylinder.radius_m, cylinder.radius_m):
            return "the same trunk as a better candidate"
    return ""


def _as_trunk(candidate: _Candidate, frame: Upright, config: DetectorConfig) -> Trunk:
    c = candidate.cylinder
    height = float(np.clip(BREAST_HEIGHT_M, candidate.low_m, candidate.high_m))
    along = (candidate.base[2] + height - c.at_m[2]) / c.axis[2]
    radius = max(c.radius_m + c.taper * along, 0.005)
    lean = float(np.arccos(min(1.0, c.axis[2])))
    axis = c.axis @ frame.R
    axis = axis / np.linalg.norm(axis)
    base = frame.to_input(candidate.base)
    at_radius = np.array([0.0, 0.0, 0.0, 0.0, 1.0, along])
    down = candidate.base[2] - c.at_m[2]
    A = np.array([[1.0, 0.0, down, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, down, 0.0, 0.0]])
    sigma_xy = float(np.sqrt(max(np.linalg.eigvalsh(A @ c.covariance @ A.T)[-1], 0.0)))
    remark = _unsuitable(radius, lean, config)
    return Trunk(
        base_m=(float(base[0]), float(base[1]), float(base[2])), axis=(float(axis[0]), float(axis[1]), float(axis[2])),
        radius_m=radius, radius_height_m=height, taper=c.taper, height_seen_m=candidate.top_m, low_seen_m=candidate.low_m,
        sigma_xy_m=sigma_xy, sigma_radius_m=float(np.sqrt(max(at_radius @ c.covariance @ at_radius, 0.0))),
        arc_rad=c.arc_rad, confidence=_confidence(candidate), layers=round((candidate.high_m - candidate.low_m) / 0.1),
        points=c.points, noise_m=c.noise_m, lean_rad=lean, suitable=not remark, remark=remark,
    )  # fmt: skip


def _unsuitable(radius: float, lean: float, config: DetectorConfig) -> str:
    if radius > config.max_suitable_radius_m:
        return "too thick"
    if radius < config.min_suitable_radius_m:
        return "too thin"
    if lean > config.max_suitable_lean_rad:
        return f"leans {np.degrees(lean):.0f} deg"
    return ""


def _confidence(candidate: _Candidate) -> float:
    """Return 0..1: how much of the height and of the arc was seen, and how clean the surface is."""
    c = candidate.cylinder
    seen = min(1.0, (candidate.high_m - candidate.low_m) / 1.5) * c.cover
    arc = min(1.0, c.arc_rad / 2.4)
    clean = c.points / (c.points + 2.0 * c.inside + 0.3 * c.around)
    return float(np.clip(0.15 + 0.85 * seen * np.sqrt(arc) * clean, 0.0, 1.0))
