"""The camera that rides on the simulated aircraft: a pose source for the simulator service."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from services.common.geometry import Matrix
from services.common.mount import Mount
from services.simulator.px4.frames import world_from_ned
from services.simulator.px4.simulated import SimulatedPx4

SLICE_S = 0.008
"""Below TIMESYNC's ten milliseconds, so that an answer given between two slices still counts."""


class FlyingCamera:
    """Carries the camera where the autopilot flies. ``advance`` lets simulated time pass, slice by slice.

    ``between(elapsed_s)`` is called after each slice with the simulated time since the start: publish the clock there
    and let a companion in another process take its turn. Without it a whole frame passes unheard: 70 ms more delay.
    ``mount`` is the true one: what ``autopilot.camera_*`` differs from it is flown as an error.
    """

    scripted = False

    def __init__(
        self,
        px4: SimulatedPx4,
        mount: Mount | None = None,
        between: Callable[[float], None] | None = None,
        end_after_landing_s: float = 3.0,
    ) -> None:
        self.px4 = px4
        self._T_body_camera = (mount or Mount.level((0.0, 0.0, 0.0))).T_body_camera
        self._between = between
        self._end_after_landing_s = end_after_landing_s
        self._acceleration = np.zeros(3)
        self._flown = False
        self._parked_s = 0.0

    @property
    def done(self) -> bool:
        """Whether the flight is over: it has flown, stands, and has been disarmed for a while."""
        return self._parked_s >= self._end_after_landing_s

    def pose(self) -> Matrix:
        """Return the true ``T_world_camera`` (4, 4) now."""
        return self.px4.true_pose() @ self._T_body_camera

    def acceleration(self) -> Matrix:
        """Return the camera's mean acceleration (3,) over the last advance, world, m/s^2, gravity not included."""
        return self._acceleration

    def advance(self, dt_s: float) -> Matrix:
        """Let ``dt_s`` pass and return ``T_world_camera``."""
        before = self._velocity()
        left_s = dt_s
        while left_s > 1e-9:
            slice_s = min(SLICE_S, left_s)
            self.px4.step(slice_s)
            left_s -= slice_s
            if self._between is not None:
                self._between(self.px4.elapsed_s)
        self._acceleration = (self._velocity() - before) / dt_s
        self._flown = self._flown or not self.px4.on_ground
        parked = self._flown and self.px4.on_ground and not self.px4.armed
        self._parked_s = self._parked_s + dt_s if parked else 0.0
        return self.pose()

    def _velocity(self) -> Matrix:
        return world_from_ned(self.px4.vehicle.body.state[3:6].copy())
