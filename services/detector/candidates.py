"""From candidate lines to trunks: fit, check, drop doubles, join forks, put into the words of the result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from services.detector.checks import (
    axis_at,
    base_point,
    prolonged_top_m,
    seen_from_eye,
    shape_fault,
    space_above_was_seen,
)
from services.detector.config import DetectorConfig
from services.detector.cylinders import MEAN_TAPER, Cylinder, fit_cylinder, fit_from
from services.detector.facing import LONGEST_M, common_eye
from services.detector.forks import BENT, Arm, Stem
from services.detector.halves import both_halves
from services.detector.joining import Candidate, join_forks, rejection
from services.detector.model import Floats, Ground, Rejection, Trunk, Views
from services.detector.stacks import Stack
from services.detector.upright import Floats32, Upright
from services.detector.voxels import Voxels

BREAST_HEIGHT_M = 1.3
_EYE_HEIGHT_M = 1.4
_NO_CYLINDER = "no cylinder through its slices"
_LEAST_ON_LINE = 0.6
_ODD_TAPER, _LEANS = 0.012, 0.1
_ARM_LAYERS = 5
"""Slices that show a fork's second arm, though no cylinder could be fitted to it (the first stands in the way)."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """All that a candidate is judged against."""

    voxels: Voxels
    above_m: Floats32
    """(L, 3) points above trunk height, upright frame."""
    views: Views | None
    frame: Upright
    ground: Ground
    span_m: float
    """Height over which a trunk must be seen."""
    config: DetectorConfig
    eye_m: Floats | None = None
    """(3,) upright frame: from where all was seen, where that is inferred."""


def judge(stacks: list[Stack], around: Surroundings) -> tuple[list[Trunk], list[Rejection]]:
    """Return the trunks, sorted by distance from the input's origin in the plan, and what was dropped and why."""
    kept: list[Candidate] = []
    rejections: list[Rejection] = []
    unsure: list[Arm] = []
    dropped: list[Stem] = []
    fits = _fits(stacks, around)
    if not around.voxels.seen_from:
        around = _look_again(stacks, fits, around)
    for stack, cylinder in zip(stacks, fits, strict=True):
        found = _examine(stack, cylinder, kept, around)
        if isinstance(found, Rejection):
            rejections.append(found)
            bent = found.reason.endswith(BENT)
            dropped.append(Stem(Arm.of_stack(stack), bent))
            if (bent or found.reason == _NO_CYLINDER) and stack.layers >= _ARM_LAYERS:
                unsure.append(Arm.of_stack(stack, bent=bent))
        else:
            kept.append(found)
    kept, joined = join_forks(kept, unsure, dropped, around.frame, around.ground)
    rejections.extend(joined)
    trunks = [_as_trunk(c, around) for c in kept]
    trunks.sort(key=lambda t: (np.hypot(t.base_m[0], t.base_m[1]), t.base_m))
    return trunks, rejections


def _fits(stacks: list[Stack], around: Surroundings) -> list[Cylinder | None]:
    """Return the joint fit of each candidate; every second one on the other core."""
    fits: list[Cylinder | None] = [None] * len(stacks)

    def work(half: int) -> None:
        for k in range(half, len(stacks), 2):
            fits[k] = fit_cylinder(around.voxels, stacks[k], around.config)

    both_halves(work, 20_000 * (len(stacks) - 1))
    return fits


def _look_again(stacks: list[Stack], fits: list[Cylinder | None], around: Surroundings) -> Surroundings:
    """Fit what was no trunk once more as seen from the place that the trunks found look at, where there is one.

    A thin trunk in noise does not tell by itself which side shows. Where none does, and nothing else is a trunk, the
    origin of coordinates is tried: there a map begins.
    """
    told = [(c, c.told_ray) for c in fits if c is not None and c.told_ray is not None]
    good = sum(c is not None and not _fault(c, around) for c in fits)
    if 2 * len(told) < good:
        return around  # most trunks show all sides: a scan from several places
    if told:
        eye = common_eye(
            np.array([c.at_m[:2] for c, _ in told]), np.array([ray for _, ray in told]), np.array([c.range_m for c, _ in told])
        )  # fmt: skip
    else:
        eye = around.frame.from_input(np.zeros(3))[:2] if good == 0 and _origin_inside(around.frame) else None
    if eye is None:
        return around
    for k, (stack, cylinder) in enumerate(zip(stacks, fits, strict=True)):
        near = float(np.hypot(*(stack.at_m[:2] - eye))) < LONGEST_M
        if not near or (cylinder is not None and (cylinder.told_ray is not None or not _fault(cylinder, around))):
            continue
        again = fit_from(eye, around.voxels, stack, around.config)
        if again is not None and not _fault(again, around):
            fits[k] = again
    z = around.ground.height_m(float(eye[0]), float(eye[1])) + _EYE_HEIGHT_M
    return replace(around, eye_m=np.array([eye[0], eye[1], z]))


def _origin_inside(frame: Upright) -> bool:
    origin = frame.from_input(np.zeros(3))[:2]
    return bool(((origin > frame.low[:2]) & (origin < frame.high[:2])).all())


def _fault(cylinder: Cylinder, around: Surroundings) -> str:
    base = base_point(cylinder, around.ground)
    low, high = cylinder.z_low_m - base[2], cylinder.z_high_m - base[2]
    return shape_fault(cylinder, low, high, around.span_m, around.config)


def _examine(
    stack: Stack, cylinder: Cylinder | None, kept: list[Candidate], around: Surroundings
) -> Candidate | Rejection:
    config = around.config
    if cylinder is None:
        return rejection(stack.at_m, stack.radius_m, stack.layers, _NO_CYLINDER, around.frame)
    base = base_point(cylinder, around.ground)
    low, high = cylinder.z_low_m - base[2], cylinder.z_high_m - base[2]
    top = high
    reason = shape_fault(cylinder, low, high, around.span_m, config) or _bent_fault(stack, cylinder)
    reason = reason or _twin_fault(cylinder, kept)
    if not reason:
        z_top = prolonged_top_m(cylinder, around.above_m, base[2] + config.look_high_m)
        top = z_top - base[2]
        reason = _post_fault(cylinder, top, z_top, around)
    if reason:
        return rejection(base, cylinder.radius_m, stack.layers, reason, around.frame)
    return Candidate(cylinder, base, low, high, top)


def _post_fault(cylinder: Cylinder, top_m: float, z_top: float, around: Surroundings) -> str:
    if top_m >= around.config.post_top_m:
        return ""
    free = axis_at(cylinder, z_top + 0.35)
    seen = space_above_was_seen(free, around.views, around.frame, around.above_m, z_top)
    if not seen and (around.eye_m is None or not seen_from_eye(free, around.eye_m, around.voxels, around.above_m)):
        return ""
    return f"ends {top_m:.1f} m above ground with free space seen above it: a post"


def _bent_fault(stack: Stack, cylinder: Cylinder) -> str:
    """Tell when one line was laid through a stem and an arm: slices between do not lie on it, and it leans or tapers oddly.

    Trunks seen by a camera have 68 to 100 % of their slices on the line (162 of 70 simulated scenes).
    """
    straight = stack.cover >= _LEAST_ON_LINE or cylinder.range_m == 0.0
    plain = abs(cylinder.taper - MEAN_TAPER) < _ODD_TAPER and float(np.hypot(*cylinder.axis[:2])) < _LEANS
    return "" if straight or plain else f"{100 * stack.cover:.0f} % of its slices {BENT}"


def _twin_fault(cylinder: Cylinder, kept: list[Candidate]) -> str:
    """Tell when the candidate shares its place with a better one."""
    for other in kept:
        z = cylinder.at_m[2]
        d = float(np.linalg.norm(axis_at(other.cylinder, z)[:2] - cylinder.at_m[:2]))
        if d < max(other.cylinder.radius_m, cylinder.radius_m) + 0.3 * min(other.cylinder.radius_m, cylinder.radius_m):
            return "the same trunk as a better candidate"
    return ""


def _as_trunk(candidate: Candidate, around: Surroundings) -> Trunk:
    c, frame = candidate.cylinder, around.frame
    height = float(np.clip(BREAST_HEIGHT_M, candidate.low_m, candidate.high_m))
    along = (candidate.base[2] + height - c.at_m[2]) / c.axis[2]
    radius = max(c.radius_m + c.taper * along, 0.005)
    lean = float(np.arccos(min(1.0, c.axis[2])))
    axis = c.axis @ frame.R
    axis = axis / np.linalg.norm(axis)
    base = frame.to_input(candidate.base)
    sigma_xy, sigma_radius = _doubts(candidate, along, radius, around.config)
    remark = _forked_low(candidate, around.config) or _unsuitable(radius, lean, around.config)
    return Trunk(
        base_m=(float(base[0]), float(base[1]), float(base[2])), axis=(float(axis[0]), float(axis[1]), float(axis[2])),
        radius_m=radius, radius_height_m=height, taper=c.taper, height_seen_m=candidate.top_m, low_seen_m=candidate.low_m,
        sigma_xy_m=sigma_xy, sigma_radius_m=sigma_radius,
        arc_rad=c.arc_rad, confidence=_confidence(candidate), layers=round((candidate.high_m - candidate.low_m) / 0.1),
        points=c.points, noise_m=c.noise_m, lean_rad=lean, suitable=not remark, remark=remark,
        range_m=c.range_m,
    )  # fmt: skip


def _doubts(candidate: Candidate, along: float, radius: float, config: DetectorConfig) -> tuple[float, float]:
    """Return the standard deviations of the base per axis and of the radius.

    Three parts that do not know of each other: the fit's own (noise, which many points average), the shape's, which stays
    however many points show one side, and for the place the map's drift.
    """
    c = candidate.cylinder
    at_radius = np.array([0.0, 0.0, 0.0, 0.0, 1.0, along])
    down = candidate.base[2] - c.at_m[2]
    A = np.array([[1.0, 0.0, down, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, down, 0.0, 0.0]])
    fit_xy = 0.5 * float(np.trace(A @ c.covariance @ A.T))
    fit_radius = float(at_radius @ c.covariance @ at_radius)
    one_sided = 1.0 - 0.5 * c.arc_rad / np.pi
    shape_xy, shape_radius = config.off_centre * radius, config.out_of_round * radius
    sigma_xy = np.sqrt(max(fit_xy, 0.0) + (one_sided + 0.1) * shape_xy**2 + config.map_drift_m**2)
    return float(sigma_xy), float(np.sqrt(max(fit_radius, 0.0) + (one_sided + 0.1) * shape_radius**2))


def _forked_low(candidate: Candidate, config: DetectorConfig) -> str:
    """Tell a fork that is low, or may be: where its stem is hidden, how high the arms' axes meet is a guess."""
    if candidate.fork_m is None:
        return ""
    if candidate.fork_m < config.suitable_fork_m:
        return f"forks {candidate.fork_m:.1f} m above ground"
    if candidate.fork_m < candidate.low_m:
        return f"forks somewhere below {candidate.low_m:.1f} m, where it is hidden"
    return ""


def _unsuitable(radius: float, lean: float, config: DetectorConfig) -> str:
    if radius > config.max_suitable_radius_m:
        return "too thick"
    if radius < config.min_suitable_radius_m:
        return "too thin"
    if lean > config.max_suitable_lean_rad:
        return f"leans {np.degrees(lean):.0f} deg"
    return ""


def _confidence(candidate: Candidate) -> float:
    """Return 0..1: how much of the height and of the arc was seen, and how clean the surface is."""
    c = candidate.cylinder
    seen = min(1.0, (candidate.high_m - candidate.low_m) / 1.5) * c.cover
    arc = min(1.0, c.arc_rad / 2.4)
    clean = c.points / (c.points + 2.0 * c.inside + 0.3 * c.around)
    return float(np.clip(0.15 + 0.85 * seen * np.sqrt(arc) * clean, 0.0, 1.0))
