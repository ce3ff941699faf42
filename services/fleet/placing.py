"""Brings each aircraft's map into the frame that all share: a tangent plane of the earth. Pure.

A map is placed by its aircraft's start point (latitude, longitude, heading), or better by the inventory, once the
pattern of its trees has laid it on the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from schemas.fleet import ClaimGoal, Vec2
from services.fleet.shapes import Stretch
from services.inventory.config import StartPoint
from services.inventory.geodesy import TangentPlane, place_of_start
from services.inventory.values import Laid


@dataclass(frozen=True, slots=True)
class SharedFrame:
    """The plane at ``origin_deg`` (latitude, longitude, altitude)."""

    origin_deg: tuple[float, float, float]
    start_of: Callable[[str], StartPoint | None]

    def place(self, uav: str, goal: ClaimGoal, laid: Laid | None = None, *, in_air: bool = False) -> Stretch | str:
        """Return a goal in the shared frame, or why it has no place there and what to configure.

        Args:
            uav: the aircraft whose map it is.
            goal: in that map.
            laid: by the inventory, when it has.
            in_air: the map was begun in the air, so that the start point says nothing of it.
        """
        start = self.start_of(uav)
        if laid is None:
            if in_air:
                return f"{uav}'s map was begun in the air: where it lies is not known until its trees are laid on the others'"
            if start is None:
                return (
                    f"no start point of {uav}: give latitude_deg, longitude_deg and heading_deg of the place it starts from "
                    f"in station.inventory.start_points (uav = {uav!r})"
                )
            laid = _by_start(start)
        plane, shared = TangentPlane(*laid.site_deg), TangentPlane(*self.origin_deg)
        reach_m = math.hypot(*goal.to_m)
        sigma_m = math.hypot(laid.sigma_m, reach_m * laid.sigma_heading_rad, goal.sigma_m)

        def shared_m(p: Vec2) -> Vec2:
            x, y, z = laid.place.apply(p[0], p[1], 0.0)
            east, north, _ = shared.from_geodetic(*plane.to_geodetic(x, y, z))
            return east, north

        return Stretch(shared_m(goal.from_m), shared_m(goal.to_m), sigma_m)


def _by_start(start: StartPoint) -> Laid:
    at = (start.latitude_deg, start.longitude_deg, start.altitude_m)
    place = place_of_start(TangentPlane(*at), *at, start.heading_deg)
    return Laid(place, at, start.sigma_m, math.radians(start.sigma_heading_deg))
