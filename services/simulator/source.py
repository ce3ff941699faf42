"""Where the camera is: on a scripted path, or on whatever else moves it."""

from __future__ import annotations

from typing import Protocol

from services.simulator.path import ReferencePath
from services.simulator.scene import Floats


class PoseSource(Protocol):
    """What carries the camera through the world."""

    scripted: bool
    """Nothing that the services say changes the pose: the next frame may be rendered while they work."""

    @property
    def done(self) -> bool:
        """Whether the flight is over."""
        ...

    def pose(self) -> Floats:
        """Return ``T_world_camera`` (4, 4) now."""
        ...

    def acceleration(self) -> Floats:
        """Return the camera's acceleration in the world now, m/s^2 (3,), gravity not included."""
        ...

    def advance(self, dt_s: float) -> Floats:
        """Move on by ``dt_s`` and return ``T_world_camera``."""
        ...


class ScriptedPose:
    """The reference's path, in time."""

    scripted = True

    def __init__(self, path: ReferencePath) -> None:
        self._path = path
        self._t_s = 0.0

    @property
    def done(self) -> bool:
        """Whether the path's end is reached."""
        return self._t_s >= self._path.duration_s

    def pose(self) -> Floats:
        """Return ``T_world_camera`` now."""
        return self._path.at(self._t_s)

    def acceleration(self) -> Floats:
        """Return the acceleration now."""
        return self._path.acceleration(self._t_s)

    def advance(self, dt_s: float) -> Floats:
        """Move along the path."""
        self._t_s += dt_s
        return self.pose()
