"""Counts how often the aircraft's body, a ball round the camera, touched something after it took off."""

from __future__ import annotations

import math


class Touches:
    """Begins when the aircraft is first clear of everything: standing on the ground before is no touch."""

    def __init__(self, body_radius_m: float) -> None:
        self._radius_m = body_radius_m
        self._airborne = False
        self._touching = False
        self.count = 0
        self.smallest_m = math.inf
        """Smallest clearance since take-off; before that the present one."""

    def update(self, clearance_m: float, *, bumped: bool = False) -> bool:
        """Take the present distance from the aircraft's centre to the nearest surface.

        ``bumped``: it hit the ground although it was not landing. Return whether a touch began.
        """
        if not self._airborne:
            self._airborne = clearance_m > self._radius_m
            self.smallest_m = clearance_m
            return False
        self.smallest_m = min(self.smallest_m, clearance_m)
        touching = bumped or clearance_m < self._radius_m
        began = touching and not self._touching
        self.count += began
        self._touching = touching
        return began
