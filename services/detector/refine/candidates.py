"""Objects in the depth image that may be trunks, each with a fitted circle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.detector.refine import kernels_fit, kernels_object, kernels_scan
from services.detector.refine.config import RefinerConfig
from services.detector.refine.model import Depth, ExpectedTree, Matrix, Sight
from services.detector.refine.view import ray_table, window_rows

MAX_RUNS = 4096
_MAX_OBJECTS = 24
_QUICK_POINTS = 250
_QUICK_ITERATIONS = 7
_ALIKE_PLACE_M = 0.06
_ALIKE_RADIUS_M = 0.04


@dataclass(frozen=True, slots=True)
class Scan:
    """The runs of one search, linked into objects."""

    depth: Depth
    ray_x: Depth
    ray_y: Depth
    sight: Sight
    runs: Matrix
    label: NDArray[np.int64]
    objects: int
    rows: NDArray[np.int64]
    noise: Matrix
    focal_px: float


@dataclass(frozen=True, slots=True)
class Fit:
    """A circle fitted to one object, in the frame along the trunk."""

    object: int
    parameters: Matrix
    """(5,): centre away, centre left, radius, lean away, lean left."""
    covariance: Matrix
    """(5, 5), inflated for correlated noise."""
    inliers: int
    inlier_share: float
    rms: float


def noise_vector(config: RefinerConfig, focal_px: float) -> Matrix:
    """Return the sensor's noise as the kernels take it."""
    return np.array([config.noise.per_m, config.noise.floor_m, 1.0 / focal_px])


def scan(
    depth_m: Depth, intrinsics: Intrinsics, sight: Sight, tree: ExpectedTree, reach_m: float,
    expected: Matrix, bounds: tuple[int, int, int, int], config: RefinerConfig,
) -> Scan:  # fmt: skip
    """Search the window ``bounds`` for objects near ``expected`` (2,), the trunk's place in its own frame."""
    search = config.search
    u0, u1, v0, v1 = bounds
    ray_x, ray_y = ray_table(intrinsics)
    rows = window_rows(v0, v1, search.rows)
    noise = noise_vector(config, intrinsics.fx)
    distance = float(np.hypot(expected[0], expected[1]))
    limits = np.array([
        search.min_depth_m, search.max_depth_m, tree.z_m + search.min_height_m, tree.z_m + search.max_height_m,
        max(distance - reach_m, 0.0), distance + reach_m,
    ])  # fmt: skip
    runs = np.empty((MAX_RUNS, kernels_scan.RUN_COLUMNS))
    count = kernels_scan.scan_rows(
        depth_m, ray_x, ray_y, sight.M, sight.up_row, float(sight.camera_m[2]), rows, u0, u1, limits, noise, runs
    )
    label = np.empty(count, np.int64)
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    objects = kernels_scan.link_runs(runs, count, step, noise, label)
    return Scan(depth_m, ray_x, ray_y, sight, runs[:count], label, objects, rows, noise, intrinsics.fx)


def candidates(
    found: Scan, trees: list[tuple[ExpectedTree, Matrix]], reach_m: float, config: RefinerConfig
) -> list[Fit]:
    """Return quick fits of the objects that may be one of ``trees`` (with their places in the frame along the trunk)."""
    fits = []
    sizes = np.bincount(found.label, minlength=found.objects)
    least = max(config.search.min_rows, int(config.search.min_height_share * len(found.rows)))
    rows, start = _as_rows(trees, config), np.empty(kernels_fit.PARAMETERS)
    radii = np.array([config.fit.min_radius_m, config.fit.max_radius_m])
    order = np.argsort(-sizes, kind="stable")[:_MAX_OBJECTS].tolist()
    for k in order:
        if sizes[k] < least:
            break
        if kernels_object.object_start(
            found.runs, found.label, k, rows, reach_m, config.search.max_spread_m, radii, start
        ):
            fit = fit_object(found, k, start, start, config, quick=True)
            if fit is not None:
                fits.append(fit)
    return fits


def _as_rows(trees: list[tuple[ExpectedTree, Matrix]], config: RefinerConfig) -> Matrix:
    """Return (T, 4): place, radius, and by how much the radius may differ."""
    change = config.fit.max_radius_change_m
    return np.array([
        (place[0], place[1], tree.radius_m, max(change, 3.0 * tree.sigma_radius_m)) for tree, place in trees
    ])  # fmt: skip


def fit_object(
    found: Scan, k: int, start: Matrix, prior: Matrix, config: RefinerConfig, *, quick: bool,
    prior_radius_sigma_m: float = 0.1,
) -> Fit | None:  # fmt: skip
    """Fit the object ``k`` from ``start`` (5,); ``prior`` gives the radius and, with zeros, the lean to prefer."""
    fit = config.fit
    limit = _QUICK_POINTS if quick else fit.max_points
    points = np.empty((limit, kernels_fit.POINT_COLUMNS))
    n = kernels_fit.gather_points(
        found.depth, found.ray_x, found.ray_y, found.sight.M, found.runs, found.label, len(found.runs), k, limit,
        found.noise, points,
    )  # fmt: skip
    if n < (fit.min_points // 2 if quick else fit.min_points):
        return None
    edges = np.empty((2 * len(found.rows), kernels_fit.EDGE_COLUMNS))
    m = kernels_fit.gather_edges(found.runs, found.label, len(found.runs), k, edges)
    sigma = np.array([1.0, 1.0, prior_radius_sigma_m, fit.prior_lean, fit.prior_lean])
    p, H, stats = np.empty(5), np.empty((5, 5)), np.empty(3)
    good = kernels_fit.fit_trunk(
        points, n, edges, m, start, prior, sigma, fit.edge_px / found.focal_px, fit.tukey,
        _QUICK_ITERATIONS if quick else fit.iterations, 4 if quick else 2, p, H, stats,
    )  # fmt: skip
    if not good or stats[0] < 3:
        return None
    rms = float(np.sqrt(stats[1] / stats[0]))
    covariance = np.empty((5, 5))
    if not kernels_fit.invert(H, covariance):
        return None
    covariance *= fit.correlation * max(1.0, rms * rms)
    return Fit(k, p, covariance, int(stats[0]), float(stats[0] / stats[2]), rms)


def join_alike(found: Scan, fit: Fit, fits: list[Fit]) -> None:
    """Give the object of ``fit`` the runs of all objects with the same circle: a trunk that noise or a branch cut."""
    for other in fits:
        d = other.parameters - fit.parameters
        if other.object != fit.object and np.hypot(d[0], d[1]) < _ALIKE_PLACE_M and abs(d[2]) < _ALIKE_RADIUS_M:
            found.label[found.label == other.object] = fit.object


def extent(found: Scan, k: int) -> tuple[tuple[float, float], tuple[int, int], float]:
    """Return (left and right column, first and last row, angle seen from the camera) of an object."""
    out = np.empty(5)
    kernels_object.object_extent(found.runs, found.label, k, out)
    left, right, first, last, angle = out.tolist()
    return (left, right), (int(first), int(last)), angle


def edges_of(found: Scan, k: int) -> NDArray[np.int64]:
    """Return (N, 3) row, left and right column of an object's edges before background, -1 where there is none."""
    edges = np.empty((2 * len(found.rows), 3), np.int64)
    return edges[: kernels_object.object_edges(found.runs, found.label, k, edges)]
