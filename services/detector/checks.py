"""What tells a trunk from a bush, a wall, a table leg, a person or a post; each check names its reason."""

from __future__ import annotations

import numpy as np
from numba import njit

from services.detector.config import DetectorConfig
from services.detector.cylinders import Cylinder
from services.detector.model import Floats, Ground, Ints, Views
from services.detector.upright import Floats32, Upright
from services.detector.voxels import Voxels

_BAND_M = 0.15
_BURIED_M = 0.3
_MAX_FILL = 0.4
"""Real trunks in five terrestrial clouds have 0 to 0.3, circles in undergrowth 0.4 to 0.7."""


def axis_at(cylinder: Cylinder, z_m: float) -> Floats:
    """Return the axis point (3,) at a height z of the upright frame."""
    return cylinder.at_m + cylinder.axis * ((z_m - cylinder.at_m[2]) / cylinder.axis[2])


def base_point(cylinder: Cylinder, ground: Ground) -> Floats:
    """Return where the axis meets the ground (3,), upright frame (a few fixed-point steps).

    Where the trunk is seen well below the ground's plane, that plane is wrong (a steep place that no point showed): the
    lowest part seen is then the best there is.
    """
    z = cylinder.z_low_m
    for _ in range(6):
        p = axis_at(cylinder, z)
        z = ground.height_m(float(p[0]), float(p[1]))
    return axis_at(cylinder, min(z, cylinder.z_low_m + _BURIED_M))


def shape_fault(cylinder: Cylinder, low_m: float, high_m: float, span_m: float, config: DetectorConfig) -> str:
    """Return why this cylinder is no trunk, or an empty text. Heights are above ground."""
    c = cylinder
    lean = float(np.arccos(min(1.0, c.axis[2])))
    noise_limit = 0.30 * c.radius_m + 0.006
    faults = (
        (lean > config.max_lean_rad, f"leans {np.degrees(lean):.0f} deg"),
        (not config.min_radius_m <= c.radius_m <= config.max_radius_m, f"radius {c.radius_m:.3f} m is out of range"),
        (high_m - low_m < span_m, f"seen over {high_m - low_m:.2f} m of height only, {span_m:.2f} needed"),
        (c.cover < config.min_cover, f"only {100 * c.cover:.0f} % of its height shows a surface"),
        (c.arc_rad < config.min_arc_rad, f"only {np.degrees(c.arc_rad):.0f} deg of arc"),
        (c.inside > 0.35 * c.points, f"{c.inside} points inside for {c.points} on the surface: a bush"),
        (c.around > 2.0 * c.points, f"{c.around} points around for {c.points} on the surface: a bush"),
        (c.range_m == 0.0 and c.fill > _MAX_FILL, f"{100 * c.fill:.0f} % as dense inside as at its surface: a bush"),
        (c.range_m == 0.0 and c.noise_m > noise_limit, f"surface scatters {100 * c.noise_m:.1f} cm: a bush"),
        (c.range_m > 0.0 and c.scale > 3.0, f"surface scatters {c.scale:.1f} times the sensor's noise: a bush"),
    )
    return next((text for bad, text in faults if bad), "")


@njit(cache=True, nogil=True)
def _top_bands(
    above: Floats32,
    x: float,
    y: float,
    z: float,
    sx: float,
    sy: float,
    r: float,
    taper: float,
    z_from: float,
    bands: Ints,
) -> None:
    """Mark in each 15 cm band above ``z_from`` which eighths of the prolonged surface, in thirds of the band, show points.

    Marks, not numbers of points: a dense cloud must not make a surface of one stray leaf.
    """
    for i in range(above.shape[0]):
        dz = above[i, 2] - z
        dx, dy = above[i, 0] - x - sx * dz, above[i, 1] - y - sy * dz
        at = max(r + taper * dz, 0.01)
        d2, reach = dx * dx + dy * dy, 0.06 + 0.3 * r
        if d2 > (at + reach) ** 2 or (at > reach and d2 < (at - reach) ** 2) or above[i, 2] < z_from:
            continue
        k = int((above[i, 2] - z_from) / _BAND_M)
        if k >= bands.shape[0]:
            continue
        third = min(2, int(((above[i, 2] - z_from) / _BAND_M - k) * 3.0))
        eighth = (4 if dx > 0.0 else 0) + (2 if dy > 0.0 else 0) + (1 if abs(dx) > abs(dy) else 0)
        bands[k] |= 1 << (8 * third + eighth)


def prolonged_top_m(cylinder: Cylinder, above_m: Floats32, z_limit_m: float) -> float:
    """Return the z (upright frame) up to which the trunk goes on without a gap of more than 0.45 m."""
    c = cylinder
    z_from = c.z_high_m
    count = int(max(0.0, (z_limit_m - z_from) / _BAND_M))
    if count == 0 or len(above_m) == 0:
        return z_from
    bands = np.zeros(count, dtype=np.int64)
    sx, sy = c.axis[:2] / c.axis[2]
    _top_bands(above_m, c.at_m[0], c.at_m[1], c.at_m[2], sx, sy, c.radius_m, c.taper, z_from, bands)
    top, gap = z_from, 0
    for k in range(count):
        if int(bands[k]).bit_count() >= 2:
            top, gap = z_from + (k + 1) * _BAND_M, 0
        else:
            gap += 1
            if gap > 3:
                break
    return top


@njit(cache=True, nogil=True)
def _places_above(above: Floats32, x: float, y: float, z_low: float, z_high: float) -> int:
    """Count the 5 cm squares of the plan within 1.5 m that show points between two heights."""
    squares = np.zeros((60, 60), dtype=np.bool_)
    count = 0
    for i in range(above.shape[0]):
        dx, dy = above[i, 0] - x, above[i, 1] - y
        if dx * dx + dy * dy >= 2.25 or not z_low < above[i, 2] < z_high:
            continue
        a, b = min(59, int((dx + 1.5) * 20.0)), min(59, int((dy + 1.5) * 20.0))
        count += 0 if squares[a, b] else 1
        squares[a, b] = True
    return count


def space_above_was_seen(p_m: Floats, views: Views | None, frame: Upright, above_m: Floats32, z_top_m: float) -> bool:
    """Tell whether the space at an upright point above a column's top was looked at.

    With posed views: some camera had it in its field of view and within reach. Without: the cloud shows other things
    within 1.5 m in the plan and at those heights, so the sensor did look up there.
    """
    if views is not None and views.rotations is not None and views.tan_half is not None:
        q = frame.to_input(p_m)
        local = np.einsum("vji,vj->vi", views.rotations, q - views.origins_m)
        z = local[:, 2]
        tan_x, tan_y = views.tan_half
        seen = (z > 0.5) & (z < 0.9 * views.max_range_m)
        seen &= (np.abs(local[:, 0]) < 0.9 * tan_x * z) & (np.abs(local[:, 1]) < 0.95 * tan_y * z)
        return bool(seen.any())
    if views is not None or len(above_m) == 0:
        return False
    return int(_places_above(above_m, float(p_m[0]), float(p_m[1]), z_top_m + 0.4, z_top_m + 1.5)) >= 20


def seen_from_eye(p_m: Floats, eye_m: Floats, voxels: Voxels, above_m: Floats32) -> bool:
    """Tell whether an eye that sees as steeply everywhere as it does somewhere had a point (3,) in view, upright frame."""
    points = np.concatenate(
        [voxels.xyz_m[:: max(1, len(voxels.xyz_m) // 5000)], above_m[:: max(1, len(above_m) // 5000)]]
    )
    d = points - eye_m
    steep = d[:, 2] / np.maximum(np.hypot(d[:, 0], d[:, 1]), 0.5)
    to = p_m - eye_m
    return bool(to[2] / max(float(np.hypot(to[0], to[1])), 0.5) < 0.9 * float(np.percentile(steep, 99.0)))


def warm_checks() -> None:
    """Run the kernels that a plain cloud does not come to."""
    above = np.zeros((2, 3), dtype=np.float32)
    _top_bands(above, 0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0, np.zeros(4, dtype=np.int64))
    _places_above(above, 0.0, 0.0, 0.0, 1.0)
