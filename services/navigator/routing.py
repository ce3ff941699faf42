"""Where to stand in front of the target, and the way there: around what is mapped, seen or moving. Pure."""

from __future__ import annotations

import numpy as np

from schemas.navigation import MissionStateName
from services.common.geometry import Matrix
from services.navigator.board import Board
from services.navigator.guard import Sweep, free_way_m
from services.navigator.moving import Mover, conflict
from services.navigator.path import clearance_m, plan, standoff

_CORNER_M = 0.25
_REPLAN_S = 1.0
_VIEW_FRESH_S = 0.5
_BODY_MARGIN_M = 0.10
_TARGET_BARK_M = 0.45
"""Surfaces this near to the target's axis are the trunk: the largest suitable radius, and the map's error."""
_KNOWN_AHEAD_M = 0.9
"""So much of the way must have been seen before it is flown."""


def docking_place(b: Board, from_m: Matrix) -> Matrix | None:
    """Return x, y of the place in front of the target that keeps clear of all else, inside the fence, or None."""
    assert b.axis_m is not None
    place = standoff(b.axis_m, from_m, b.config.dock.aim_m, b.discs(b.config.safety_radius_m))
    body, fence = b.discs(b.config.aircraft_radius_m + _BODY_MARGIN_M), b.fence_disc
    outside = fence is not None and clearance_m(place, [fence]) > 0.0
    return place if not outside and clearance_m(place, body) >= 0.0 else None


def route(b: Board, start: Matrix, goal: Matrix) -> list[Matrix] | None:
    """Return the corners to ``goal``, planned anew once a second or when the map moved."""
    while b.corners and float(np.linalg.norm(b.corners[0] - start)) < _CORNER_M:
        b.corners = b.corners[1:]
    if b.planned_ns < 0 or (b.now_ns - b.planned_ns) / 1e9 > _REPLAN_S:
        corners = _planned(b, start, goal)
        if corners is None:
            return None
        b.corners, b.planned_ns = corners[:-1], b.now_ns
    return [*b.corners, goal]


def _planned(b: Board, start: Matrix, goal: Matrix) -> list[Matrix] | None:
    space = b.around.space
    unknown = space.unknown_cells if b.config.live_guard and space.fed else None
    return plan(start, goal, b.discs(b.config.safety_radius_m), b.fence_disc, unknown)


def unknown_ahead(b: Board, start: Matrix, corner: Matrix) -> bool:
    """Whether the next stretch of the way was never seen: unknown space is not free."""
    space = b.around.space
    if not b.config.live_guard or not space.fed:
        return False
    way = corner - start
    length = float(np.linalg.norm(way))
    if length < 0.05:
        return False
    stretch = min(length, _KNOWN_AHEAD_M)
    known = space.known_ahead_m(start, start + way * (stretch / length), b.config.aircraft_radius_m)
    return known < stretch - 1e-9


def seen_free_m(b: Board, way: Matrix) -> float:
    """Return how far the depth image says the way (2,) is free, inf when there is none to say so."""
    c, here, seen = b.config, b.here, b.inputs.view
    if not c.live_guard or here is None or seen is None or b.inputs.age_s(seen) > _VIEW_FRESH_S:
        return float("inf")
    target = None if b.axis_m is None else b.axis_m - here.position_m[:2]
    sweep = Sweep(c.aircraft_radius_m + _BODY_MARGIN_M, c.guard_height_m, _TARGET_BARK_M)
    return free_way_m(seen.message, way, target, sweep)


def moving_into(b: Board, velocity_m_s: Matrix) -> Mover | None:
    """Return what will be too near within a second when the aircraft goes on with this velocity (2,), or None."""
    here = b.here
    if here is None or not b.config.live_guard:
        return None
    moving = b.around.moving(b.now_ns)
    keep = b.config.aircraft_radius_m + _BODY_MARGIN_M
    return conflict(here.position_m[:2], velocity_m_s, moving, b.now_ns, keep)


def retreat(b: Board) -> Matrix | None:
    """Return a place (2,) to give way to, when something came too near; None when nothing did, or there is no room."""
    here = b.here
    keep = b.config.aircraft_radius_m + _BODY_MARGIN_M
    if here is None or not b.config.live_guard:
        return None
    start, near = here.position_m[:2], b.around.discs(keep, b.now_ns)
    if clearance_m(start, near) >= 0.0:
        return None
    worst = min(near, key=lambda d: float(np.hypot(start[0] - d.x_m, start[1] - d.y_m)) - d.keep_out_m)
    away = float(np.arctan2(start[1] - worst.y_m, start[0] - worst.x_m))
    for turn in _WAYS_RAD:
        place = start + _RETREAT_M * np.array([np.cos(away + turn), np.sin(away + turn)])
        better = clearance_m(place, b.discs(keep)) > clearance_m(start, b.discs(keep)) + 0.1
        known = b.around.space.known_ahead_m(start, place, _NARROW_M) >= _RETREAT_M - 1e-6
        inside = b.fence_disc is None or clearance_m(place, [b.fence_disc]) <= 0.0
        if better and known and inside:
            return np.asarray(place)
    return None


_RETREAT_M, _NARROW_M = 0.5, 0.25
_WAYS_RAD = (0.0, 0.6, -0.6, 1.2, -1.2)


def way_round(b: Board, doing: MissionStateName) -> bool | None:
    """Whether there is a clear way on for what is being done; None where nothing can be planned for it."""
    here = b.here
    if here is None or doing not in ("approach", "return"):
        return None
    start = here.position_m[:2]
    goal = b.home_m[:2] if doing == "return" and b.home_m is not None else None
    if doing == "approach" and b.axis_m is not None:
        goal = docking_place(b, start)
    corners = None if goal is None else _planned(b, start, goal)
    if corners is None:
        return False
    way = corners[0] - start
    length = float(np.linalg.norm(way))
    if length < 0.05:
        return True
    free = seen_free_m(b, way) >= min(b.config.safety_radius_m, length + b.config.aircraft_radius_m)
    return free and moving_into(b, way * (b.config.approach_speed_m_s / length)) is None
