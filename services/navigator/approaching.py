"""The approach: to a place in front of the target, never where nobody looks. Pure.

On the last leg the camera faces the target. Before that it looks where the aircraft flies: what comes up there is seen
by the live guard, and space that no view has shown is looked at before it is entered.
"""

from __future__ import annotations

import numpy as np

from services.common.geometry import Matrix, wrap_angle
from services.navigator.board import Board
from services.navigator.routing import docking_place, route, unknown_ahead
from services.navigator.trajectory import Aim
from services.navigator.underfoot import least_z_m
from services.navigator.values import Intent, Next

FACING_RAD = float(np.radians(5.0))
TURN_FIRST_RAD = float(np.radians(8.0))
"""Guidance says turn rather than toward beyond this heading error."""
_IN_VIEW_RAD = float(np.radians(20.0))
"""A way this near to where the camera looks is watched well enough."""
_YAW_LEAD_NS = 300_000_000
"""The aircraft's yaw follows its setpoint by about this much later."""


def approach(b: Board, since_s: float) -> Intent | Next:
    """Entry: the target is ahead. Exit: near enough -> dock; no way to it, or not in time -> select."""
    del since_s
    c, here, seen = b.config, b.here, b.to_axis()
    if b.axis_m is None or b.following.astray:
        return gone(b)
    if here is None or seen is None:
        return Intent("stop", "freeze")
    distance, bearing = seen
    if (b.now_ns - b.target_since_ns) / 1e9 > c.target_timeout_s:
        return give_up(b, f"tree {b.target_id} not reached in {c.target_timeout_s:.0f} s")
    goal_xy = docking_place(b, here.position_m[:2])
    way = None if goal_xy is None else route(b, b.trajectory.position_m[:2], goal_xy)
    if goal_xy is None or way is None:
        return give_up(b, f"no clear way to tree {b.target_id}")
    last_leg = len(way) == 1
    watched = _watch_the_way(b, way[0], last_leg=last_leg)
    if watched is not None:
        return watched
    if last_leg and distance <= c.dock.enter_m and abs(bearing) < 2.0 * FACING_RAD:
        b.dock.clear()
        b.dock_direction = (goal_xy - b.axis_m) / float(np.linalg.norm(goal_xy - b.axis_m))
        b.dock_offset_m = b.dock_yaw_rad = 0.0
        return Next("dock", f"{distance:.2f} m from tree {b.target_id}")
    to_go = float(np.linalg.norm(way[0] - here.position_m[:2]))
    aim = Aim(at_height(b, way[0]), yaw_to_axis(b), c.approach_speed_m_s, c.turn_rate_rad_s, c.approach_gain_per_s)
    if abs(bearing) > TURN_FIRST_RAD and last_leg:
        aim = Aim(at_height(b, b.trajectory.position_m[:2]), yaw_to_axis(b), 0.1, c.turn_rate_rad_s)
        return _turn(aim, bearing)
    return Intent("toward", "aim", aim, to_go, "m")


def _watch_the_way(b: Board, corner: Matrix, *, last_leg: bool) -> Intent | Next | None:
    """Return what has to be done so that the camera sees the way, None when it sees it while it faces the target."""
    assert b.here is not None
    assert b.axis_m is not None
    start, c = b.trajectory.position_m[:2], b.config
    ahead, target = corner - start, b.axis_m - start
    heading = float(np.arctan2(ahead[1], ahead[0]))
    aside = abs(wrap_angle(heading - float(np.arctan2(target[1], target[0]))))
    unknown = unknown_ahead(b, start, corner)
    detour = not last_leg and aside > _IN_VIEW_RAD and c.live_guard
    if not unknown and not detour:
        if not b.looking:
            return None
        b.looking = False
        return Next("face", "the way to the target is open: facing it again")
    yaw = b.trajectory.unwrapped(heading)
    turn = wrap_angle(yaw - b.here.yaw_rad)
    if not unknown or not b.looking or abs(turn) > FACING_RAD:
        b.look_since_ns = b.now_ns
    b.looking = True
    if (b.now_ns - b.look_since_ns) / 1e9 > c.look_s:
        return give_up(b, f"nobody can see whether the way to tree {b.target_id} is free")
    if unknown or abs(turn) > _IN_VIEW_RAD:
        return _turn(Aim(at_height(b, start), yaw, 0.2, c.turn_rate_rad_s), turn)
    to_go = float(np.linalg.norm(corner - b.here.position_m[:2]))
    aim = Aim(at_height(b, corner), yaw, c.approach_speed_m_s, c.turn_rate_rad_s, c.approach_gain_per_s)
    return Intent("toward", "aim", aim, to_go, "m")


def _turn(aim: Aim, angle_rad: float) -> Intent:
    return Intent("turn_left" if angle_rad > 0.0 else "turn_right", "aim", aim, abs(angle_rad), "rad")


def give_up(b: Board, reason: str) -> Next:
    """Leave the target and look for another."""
    b.finish_target(visited=False)
    b.drop_target()
    return Next("select", reason)


def gone(b: Board) -> Next:
    """Choose anew, as the target is not in the map any more or its id is another tree's; given up at the second time."""
    why = b.following.astray or "the target is gone from the map"
    if b.following.astray and b.following.astray_again:
        return give_up(b, f"{why}, again")
    b.drop_target()
    return Next("select", why)


def at_height(b: Board, xy: Matrix) -> Matrix:
    """Return a place (3,) at flight height, higher where the known ground there, or under the aircraft, asks for it."""
    least = max(least_z_m(b, xy), least_z_m(b, b.trajectory.position_m[:2]))
    return np.array([xy[0], xy[1], min(max(b.flight_z_m, least), b.ceiling_z_m)])


def yaw_to_axis(b: Board) -> float:
    """Return the setpoint yaw (unwrapped) that looks at the axis from where the camera will be when it is reached."""
    assert b.axis_m is not None
    assert b.here is not None
    offset = b.axis_m - b.track.predict(b.now_ns + _YAW_LEAD_NS)[:2, 3]
    return b.trajectory.unwrapped(float(np.arctan2(offset[1], offset[0])))
