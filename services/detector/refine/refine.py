"""Find one mapped trunk in one depth image and measure it: bearing, range and radius with their covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from schemas.camera import Intrinsics
from services.detector.refine import kernels_place
from services.detector.refine.associate import associate
from services.detector.refine.candidates import Fit, Scan, candidates, edges_of, extent, fit_object, join_alike, scan
from services.detector.refine.config import RefinerConfig
from services.detector.refine.model import Depth, ExpectedTree, Matrix, Measurement, Sight
from services.detector.refine.view import axis_point, gate_m, pose_offset_covariance, project_point, sight, window

_NO_POSE_ERROR = np.zeros((2, 2))
_MIN_DEPTH_M = 0.1


def refine(
    depth_m: Depth, intrinsics: Intrinsics, T_map_camera: Matrix, pose_covariance: Matrix | None,
    expected: ExpectedTree, others: Sequence[ExpectedTree], config: RefinerConfig,
) -> Measurement | None:  # fmt: skip
    """Measure the trunk ``expected`` in ``depth_m`` (H, W) float32 metres, 0 or NaN where there is no data.

    The mapped trunk is projected with its own and the pose's uncertainty; objects around that place are cut out of the
    depth image, fitted and told apart by place and radius with all ``others`` known nearby; the one that is the target
    is fitted in full.

    Returns:
        The measurement, or None when the target is not seen for certain: never the next best object.
    """
    view = sight(T_map_camera, expected.axis)
    if view is None:
        return None
    shift = _NO_POSE_ERROR
    if pose_covariance is not None:
        shift = pose_offset_covariance(
            axis_point(expected, float(view.camera_m[2])) - view.camera_m[:2], pose_covariance
        )
    gate = gate_m(np.eye(2) * expected.sigma_xy_m**2 + shift, config.search)
    trees = [(tree, _place(tree, view)) for tree in _near(expected, others, gate)]
    # a neighbour that could be taken for the target must be looked at itself, or nothing tells the two apart
    reach = gate + max(tree.radius_m + float(np.hypot(*(place - trees[0][1]))) for tree, place in trees)
    bounds = window(expected, T_map_camera, intrinsics, reach, config.search)
    if bounds is None:
        return None
    found = scan(depth_m, intrinsics, view, expected, reach, trees[0][1], bounds, config)
    fits = candidates(found, trees, gate, config)
    turn = view.basis[:2, :2]  # fits and places are in the sight's frame, the pose's shift is in map
    match = associate(fits, trees, turn @ shift @ turn.T, gate)
    if match is None:
        return None
    join_alike(found, match.fit, fits)
    fit = _fit_in_full(found, match.fit, expected, config)
    if fit is None or not acceptable(fit, expected, config):
        return None
    return _measurement(fit, found, intrinsics, T_map_camera, expected, shift, config)


def _near(expected: ExpectedTree, others: Sequence[ExpectedTree], gate: float) -> list[ExpectedTree]:
    """Return the target and those others whose objects may turn up in its window."""
    reach = 2.0 * gate
    near = [
        tree
        for tree in others
        if tree.id != expected.id and math.hypot(tree.x_m - expected.x_m, tree.y_m - expected.y_m) < reach
    ]
    return [expected, *near]


def _place(tree: ExpectedTree, view: Sight) -> Matrix:
    """Return where the tree's axis passes the camera's plane across the target's trunk, (2,) in the sight's frame."""
    offset = np.append(axis_point(tree, float(view.camera_m[2])) - view.camera_m[:2], 0.0)
    along = np.asarray(tree.axis)
    a, offset_f = view.basis @ along, view.basis @ offset
    return np.asarray((offset_f - a * (offset_f[2] / a[2]))[:2])


def _fit_in_full(found: Scan, quick: Fit, tree: ExpectedTree, config: RefinerConfig) -> Fit | None:
    """Fit the target's object with all its points and the map's radius as a weak prior."""
    prior = np.array([quick.parameters[0], quick.parameters[1], tree.radius_m, 0.0, 0.0])
    sigma = max(3.0 * tree.sigma_radius_m, config.fit.prior_radius_m)
    return fit_object(found, quick.object, quick.parameters, prior, config, quick=False, prior_radius_sigma_m=sigma)


def acceptable(fit: Fit, tree: ExpectedTree, config: RefinerConfig) -> bool:
    """Tell whether a fit is good enough to be the tree: radius, residuals, enough of the object explained."""
    limits = config.fit
    change = max(limits.max_radius_change_m, 3.0 * tree.sigma_radius_m)
    radius = float(fit.parameters[2])
    return (
        limits.min_radius_m <= radius <= limits.max_radius_m
        and abs(radius - tree.radius_m) <= change
        and fit.rms <= limits.max_rms
        and fit.inlier_share >= limits.min_inlier_share
        and fit.inliers >= limits.min_points
    )


def _measurement(
    fit: Fit, found: Scan, intrinsics: Intrinsics, T_map_camera: Matrix, tree: ExpectedTree, shift: Matrix,
    config: RefinerConfig,
) -> Measurement | None:  # fmt: skip
    view = found.sight
    offset, covariance, polar_covariance = np.empty(2), np.empty((3, 3)), np.empty((3, 3))
    distance = kernels_place.polar(
        fit.parameters, fit.covariance, view.basis, config.fit.systematic_m, offset, covariance, polar_covariance
    )
    f = view.forward
    bearing = math.atan2(f[0] * offset[1] - f[1] * offset[0], f[0] * offset[0] + f[1] * offset[1])
    x, y, z = (offset @ T_map_camera[:2, :3]).tolist()
    if z < _MIN_DEPTH_M:
        return None
    columns, rows, angle = extent(found, fit.object)
    position = view.camera_m[:2] + offset
    moved = position - axis_point(tree, float(view.camera_m[2]))
    # a cylinder shows 180 degrees less the angle between its tangents; what is seen of that is in proportion
    half = math.asin(min(float(fit.parameters[2]) / distance, 0.99))
    return Measurement(
        tree_id=tree.id, bearing_rad=bearing, range_m=distance, radius_m=float(fit.parameters[2]),
        image_x_px=project_point(x, y, z, intrinsics)[0],
        covariance=polar_covariance,
        position_map_m=(float(position[0]), float(position[1])), covariance_map_m2=covariance[:2, :2] + shift,
        rms=fit.rms, inliers=fit.inliers, inlier_share=fit.inlier_share,
        arc_rad=min(1.0, 0.5 * angle / half) * (math.pi - 2.0 * half), columns_px=columns, rows_px=rows,
        shift_m=(float(moved[0]), float(moved[1])), edges_px=edges_of(found, fit.object),
    )  # fmt: skip
