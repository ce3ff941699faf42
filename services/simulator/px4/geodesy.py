"""Local metres to latitude and longitude and back, on a sphere around an origin (good to millimetres nearby)."""

from __future__ import annotations

import math

EARTH_RADIUS_M = 6_371_000.0

TRUTH_ORIGIN = (47.397742, 8.545594, 488.0)
"""Where HIL_STATE_QUATERNION places the world's origin: latitude and longitude in degrees, height in metres."""


def to_global(origin: tuple[float, float, float], ned_m: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return latitude and longitude (degrees) and height (metres) of a NED offset from ``origin``."""
    latitude = origin[0] + math.degrees(ned_m[0] / EARTH_RADIUS_M)
    longitude = origin[1] + math.degrees(ned_m[1] / (EARTH_RADIUS_M * math.cos(math.radians(origin[0]))))
    return latitude, longitude, origin[2] - ned_m[2]


def to_local(origin: tuple[float, float, float], place: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return the NED offset (metres) of a place (degrees, degrees, metres) from ``origin``."""
    north = math.radians(place[0] - origin[0]) * EARTH_RADIUS_M
    east = math.radians(place[1] - origin[1]) * EARTH_RADIUS_M * math.cos(math.radians(origin[0]))
    return north, east, origin[2] - place[2]
