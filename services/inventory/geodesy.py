"""WGS84: geodetic coordinates, earth-centred ones, and the tangent plane of a point. Pure.

Closed formulas of the ellipsoid (NIMA TR8350.2, sections 3 and 4.3); the way back to latitude by Bowring's method
(Bowring, "Transformation from spatial to geographical coordinates", Survey Review 1976), which is below a
micrometre near the ground. The tangent plane (east, north, up) is exact: nothing is projected.
"""

from __future__ import annotations

import math

from services.inventory.values import Rigid2

_A_M = 6_378_137.0
_F = 1.0 / 298.257223563
_B_M = _A_M * (1.0 - _F)
_E2 = _F * (2.0 - _F)
_EP2 = _E2 / (1.0 - _E2)

Vector = tuple[float, float, float]


def earth_from_geodetic(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vector:
    """Return earth-centred, earth-fixed coordinates, metres."""
    lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
    n = _A_M / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
    return (
        (n + altitude_m) * math.cos(lat) * math.cos(lon),
        (n + altitude_m) * math.cos(lat) * math.sin(lon),
        (n * (1.0 - _E2) + altitude_m) * math.sin(lat),
    )


def geodetic_from_earth(p: Vector) -> Vector:
    """Return latitude and longitude, degrees, and altitude, metres."""
    x, y, z = p
    r = math.hypot(x, y)
    beta = math.atan2(z * _A_M, r * _B_M)
    lat = math.atan2(z + _EP2 * _B_M * math.sin(beta) ** 3, r - _E2 * _A_M * math.cos(beta) ** 3)
    n = _A_M / math.sqrt(1.0 - _E2 * math.sin(lat) ** 2)
    # the second form holds at the poles too, where cos(lat) vanishes
    altitude = r * math.cos(lat) + z * math.sin(lat) - _A_M**2 / n
    return math.degrees(lat), math.degrees(math.atan2(y, x)), altitude


class TangentPlane:
    """East, north, up about one point."""

    def __init__(self, latitude_deg: float, longitude_deg: float, altitude_m: float = 0.0) -> None:
        self._origin = earth_from_geodetic(latitude_deg, longitude_deg, altitude_m)
        lat, lon = math.radians(latitude_deg), math.radians(longitude_deg)
        sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
        self._east: Vector = (-so, co, 0.0)
        self._north: Vector = (-sl * co, -sl * so, cl)
        self._up: Vector = (cl * co, cl * so, sl)

    def to_geodetic(self, east_m: float, north_m: float, up_m: float) -> Vector:
        """Return latitude, longitude (degrees) and altitude of a point."""
        x, y, z = (
            o + east_m * e + north_m * n + up_m * u
            for o, e, n, u in zip(self._origin, self._east, self._north, self._up, strict=True)
        )
        return geodetic_from_earth((x, y, z))

    def from_geodetic(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vector:
        """Return east, north, up of a point, metres."""
        p = earth_from_geodetic(latitude_deg, longitude_deg, altitude_m)
        d = tuple(a - b for a, b in zip(p, self._origin, strict=True))
        return _dot(d, self._east), _dot(d, self._north), _dot(d, self._up)


def _dot(a: tuple[float, ...], b: Vector) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def place_of_start(
    site: TangentPlane, latitude_deg: float, longitude_deg: float, altitude_m: float, heading_deg: float
) -> Rigid2:
    """Return what takes a map to the site's plane: it begins at the start point and looks along ``heading_deg``.

    A heading h (clockwise from north) points east by sin h and north by cos h: the map's x axis stands at 90 deg - h,
    measured from east to the left. The start point's own north is used: meridians converge.
    """
    east, north, up = site.from_geodetic(latitude_deg, longitude_deg, altitude_m)
    own = TangentPlane(latitude_deg, longitude_deg, altitude_m)
    heading = math.radians(heading_deg)
    ahead = own.to_geodetic(math.sin(heading), math.cos(heading), 0.0)
    ahead_east, ahead_north, _ = site.from_geodetic(*ahead)
    return Rigid2(math.atan2(ahead_north - north, ahead_east - east), east, north, up)
