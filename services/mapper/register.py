"""Registration: moves a keyframe's cloud onto the local submap (the keyframes around it), or leaves it where slam put it.

Projective point-to-plane ICP (Chen and Medioni, 1992; projective association after Blais and Levine, 1995) on depth
images reduced by block medians, weighted by the depth noise along the viewing ray of both sides, robust (Tukey), with
slam's pose as a prior: the step minimises

    sum_i rho((n_i . (T p_i - q_i)) / sigma_i) + |delta / prior sigma|^2 .

Never worse: a correction counts only when points that took no part in finding it fit better, and when it is likely
under the prior (chi-square of 6, 99 %).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import exp_rotation, inverse, pose
from services.mapper.register_kernels import accumulate, normals, reduce

Matrix = NDArray[np.float64]
Floats32 = NDArray[np.float32]

_CHI2_6_99 = 16.81
_TUKEY = 4.0
_MIN_PAIRS = 300
_SHARE = 0.03
"""Pixels share a sensor's fixed pattern and the errors of normals: they count as so many of what they claim."""
_BARK_M = 0.004
"""Roughness of bark and ground: noise that does not fall with range."""


@dataclass(frozen=True, slots=True)
class RangeView:
    """A keyframe's depth, reduced: points and normals on a coarse image grid, camera frame."""

    points_m: Floats32 = field(repr=False)
    """(h, w, 3), z = 0 where there is none."""
    normals: Floats32 = field(repr=False)
    """(h, w, 3), zero where there is none."""
    scale: float
    """Full pixels per coarse pixel."""
    focal_px: tuple[float, float, float, float]
    """fx fy cx cy of the coarse image."""


@dataclass(frozen=True, slots=True)
class Registration:
    """What registering one keyframe gave."""

    accepted: bool
    T_correction: Matrix
    """Left factor, map frame: the registered pose is ``T_correction @ T_map_camera``."""
    pairs: int
    cost_before: float
    """Mean robust cost of the points held out, at slam's pose."""
    cost_after: float
    chi2: float
    """Of the correction under the prior."""


NOT_REGISTERED = Registration(
    accepted=False, T_correction=np.eye(4), pairs=0, cost_before=0.0, cost_after=0.0, chi2=0.0
)


def range_view(
    depth_m: Floats32, rays: Floats32, focal_px: tuple[float, float, float, float], slope: float, block: int = 4
) -> RangeView:
    """Return the reduced view of a depth image (H, W) metres.

    Args:
        depth_m: 0 where there is no data; the filters of ``keyframe_cloud`` are not needed before.
        rays: of ``pixel_rays``.
        focal_px: fx fy cx cy of the full image; lens distortion is left out of the association only.
        slope: depth noise at one metre.
        block: full pixels per side of a coarse one.
    """
    h, w = depth_m.shape[0] // block, depth_m.shape[1] // block
    points, upright = np.zeros((h, w, 3), dtype=np.float32), np.zeros((h, w, 3), dtype=np.float32)
    reduce(depth_m, rays, block, slope, points)
    normals(points, slope, upright)
    fx, fy, cx, cy = focal_px
    centre = (block - 1) / 2
    return RangeView(points, upright, block, (fx / block, fy / block, (cx - centre) / block, (cy - centre) / block))


@dataclass(frozen=True, slots=True)
class Placed:
    """A reference view and where it stands."""

    view: RangeView
    T_map_camera: Matrix


def register(
    source: RangeView,
    T_map_camera: Matrix,
    references: list[Placed],
    sigma: Matrix,
    slope: float,
    rounds: int = 8,
) -> Registration:
    """Return the correction that lays ``source`` on the references, accepted only where it is better and likely.

    Args:
        source: the new keyframe.
        T_map_camera: where slam put it.
        references: overlapping keyframes, trusted.
        sigma: (6,) prior standard deviations of (x y z rx ry rz) of the pose against the references.
        slope: depth noise at one metre.
        rounds: Gauss-Newton steps.
    """
    before, pairs = _cost(source, T_map_camera, references, slope, 1)
    if pairs < _MIN_PAIRS:
        return NOT_REGISTERED
    centre, delta = T_map_camera[:3, 3].copy(), np.zeros(6)
    information = np.diag(1.0 / sigma**2)
    for _ in range(rounds):
        A, g = np.zeros((6, 6)), np.zeros(6)
        n = _sum(source, _moved(delta, centre) @ T_map_camera, references, slope, 0, centre, A, g)[1]
        if n < _MIN_PAIRS:
            return NOT_REGISTERED
        step = np.linalg.solve(_SHARE * A + information, -(_SHARE * g + information @ delta))
        delta = delta + step
        if float(np.abs(step / sigma).max()) < 0.005:
            break
    correction = _moved(delta, centre)
    after, _ = _cost(source, correction @ T_map_camera, references, slope, 1)
    chi2 = float(delta @ information @ delta)
    accepted = after < before * 0.995 and chi2 < _CHI2_6_99
    return Registration(
        accepted=accepted, T_correction=correction if accepted else np.eye(4), pairs=pairs, cost_before=before,
        cost_after=after, chi2=chi2,
    )  # fmt: skip


def _moved(delta: Matrix, centre: Matrix) -> Matrix:
    R = exp_rotation(delta[3:])
    return pose(R, centre + delta[:3] - R @ centre)


def _cost(source: RangeView, T: Matrix, references: list[Placed], slope: float, parity: int) -> tuple[float, int]:
    total, pairs = _sum(source, T, references, slope, parity, T[:3, 3], np.zeros((6, 6)), np.zeros(6))
    return (total / pairs if pairs else 0.0), pairs


def _sum(
    source: RangeView, T: Matrix, references: list[Placed], slope: float, parity: int, centre: Matrix, A: Matrix,
    g: Matrix,
) -> tuple[float, int]:  # fmt: skip
    total, pairs = 0.0, 0
    for reference in references:
        R, t = np.ascontiguousarray(reference.T_map_camera[:3, :3]), reference.T_map_camera[:3, 3].copy()
        cost, n = accumulate(
            source.points_m, inverse(reference.T_map_camera) @ T, R, t, np.ascontiguousarray(centre),
            reference.view.points_m, reference.view.normals, *reference.view.focal_px, slope, _BARK_M, _TUKEY, parity, A, g,
        )  # fmt: skip
        total += float(cost)
        pairs += int(n)
    return total, pairs
