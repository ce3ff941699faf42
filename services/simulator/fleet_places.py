"""Where the aircraft of a fleet stand in one scene. Pure."""

from __future__ import annotations

import math

from services.common.errors import InputError
from services.simulator.scene import Scene

Place = tuple[float, float]

APART_M = 5.5
"""Two starts at least: claims keep 3 m, their doubts come on top, and each is to turn and dock beside its own."""
ROOM_M = 1.5
"""Free of trunks and bushes round a start."""
_RING_M, _AZIMUTHS = 5.5, 72
"""No farther out: from there the background's trunks, which are no part of the truth, are in the camera's reach."""
_SEEN_M = 5.5


def fleet_places(scene: Scene, count: int) -> tuple[Place, ...]:
    """Return a start for each of ``count`` aircraft: the scene's own, and places from which most trees are near.

    Raises:
        InputError: the scene has no room for so many.
    """
    places: list[Place] = [(0.0, 0.0)]
    while len(places) < count:
        free = [
            p for p in _grid() if _room_m(scene, p) >= ROOM_M and all(math.dist(p, q) >= APART_M - 1e-9 for q in places)
        ]
        if not free:
            raise InputError(
                f"--aircraft {count}: scene {scene.name} of seed {scene.seed} has room for {len(places)} only, "
                f"{APART_M:g} m apart: ask for fewer, or for another --seed"
            )
        places.append(max(free, key=lambda p: (_near(scene, p), _room_m(scene, p))))
    return tuple(places)


def _grid() -> list[Place]:
    turns = [2.0 * math.pi * k / _AZIMUTHS for k in range(_AZIMUTHS)]
    return [(_RING_M * math.cos(a), _RING_M * math.sin(a)) for a in turns]


def _room_m(scene: Scene, place: Place) -> float:
    return min((math.dist(place, (x, y)) - radius for x, y, radius in scene.things()), default=math.inf)


def _near(scene: Scene, place: Place) -> int:
    return sum(math.dist(place, (t.x_m, t.y_m)) <= _SEEN_M for t in scene.suitable_trees)
