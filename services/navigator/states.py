"""The states of the mission: what each wants while it lasts, and when it ends. Pure.

Each function takes the board and the seconds since entry and returns an intent, or the next state with its reason.
Entry conditions are the reasons of the transitions that lead there; docs/safety.md tells what interrupts them all.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from schemas.navigation import MissionStateName
from services.common.geometry import Matrix, wrap_angle
from services.navigator.approaching import (
    FACING_RAD,
    TURN_FIRST_RAD,
    approach,
    at_height,
    give_up,
    gone,
    yaw_to_axis,
)
from services.navigator.battery import too_low_for_another, unknown_word
from services.navigator.board import Board
from services.navigator.claiming import home_goal, tree_goal
from services.navigator.routing import route
from services.navigator.selection import Choice, choose
from services.navigator.trajectory import Aim
from services.navigator.values import Intent, Next

Result = Intent | Next

_HEIGHT_TOLERANCE_M = 0.12
_STILL_M_S = 0.15
_HANDHELD_GAPS = 2
"""Of 36 headings: a person turns as a person does."""
_SLOW_SHARE, _SURE_TIMES, _RELOCKS = 0.4, 1.5, 2
"""Of the scan's rate; of the inliers below which slam falters; tries at one place."""
_SLOW_RAD, _NEW_PLACE_RAD = float(np.radians(30.0)), float(np.radians(20.0))
_CENTRED_RAD = float(np.radians(2.0))
_GAP_M = 0.025
"""Guidance says stop within this distance of the aim."""
_YAW_INTEGRAL_SHARE = 0.4
_SETTLED_M_S = 0.06
"""Standing offsets are learnt below this speed of the setpoint: while it moves, the aircraft's lag is no offset."""
_AWAY_M = 0.5
"""Nearer to its start than this it has nowhere to give way to."""
_OVER_START_M, _AT_START_M = 0.2, 0.05
_STILL_S, _SETTLE_S = 1.0, 4.0
"""Within the first of the start it comes to rest and waits for the second, so long at most. PX4's landing coasts on from where it is
asked for: landing at once, each mission of a day began 0.3 m from the one before, until the start lay in the undergrowth."""
_LEAVE_WITHIN_S = 6.0
"""Backing off without a claim takes no longer: the rest of the lease is for coming down."""
_YAW_CORRECTION_RAD = float(np.radians(8.0))


def take_off(b: Board, since_s: float) -> Result:
    """Entry: preflight passed. Exit: armed, at flight height and still -> scan; not armed or risen in time -> failed."""
    here, v, c = b.here, b.vehicle, b.config
    if c.handheld:
        return Next("scan", "held by a person: no take-off") if here is not None else Intent("stop")
    flying = v is not None and v.armed and v.mode == "offboard"
    if not flying:
        if since_s > c.arm_wait_s:
            return Next("failed", f"the autopilot did not arm in offboard: {v.note if v else 'no word from it'}")
        return Intent("take_off", "follow", magnitude=0.0, unit="m")
    if here is None or b.home_m is None:
        return Intent("stop", "freeze")
    left = b.flight_z_m - float(here.position_m[2])
    speed = float(np.linalg.norm(b.track.velocity_m_s))
    if abs(left) < _HEIGHT_TOLERANCE_M and speed < _STILL_M_S:
        return Next("scan", f"at {float(here.position_m[2]) + c.start_height_m:.2f} m above the start")
    if since_s > c.arm_wait_s + c.takeoff_wait_s:
        return Next("landing", f"did not reach its height: {left:+.2f} m to go")
    goal = np.array([b.home_m[0], b.home_m[1], b.flight_z_m])
    return Intent("take_off", "aim", Aim(goal, b.trajectory.yaw_rad, c.climb_speed_m_s, 0.0), max(left, 0.0), "m")


def scan(b: Board, since_s: float) -> Result:
    """Entry: at flight height. Exit: turned once with overlap and every heading seen -> select; else a second turn.

    Where slam falters (few inliers) it turns back to the last heading at which slam was sure, and comes again slowly.
    """
    del since_s
    c, here = b.config, b.here
    if here is None:
        return Intent("stop", "freeze")
    whole, turned = 2.0 * np.pi + c.scan_overlap_rad, abs(b.scan_turned_rad)
    if turned >= whole and (b.scan_gaps == 0 or turned >= c.scan_turns_max * 2.0 * np.pi):
        gaps = f", {b.scan_gaps} of 36 headings unseen" if b.scan_gaps else ""
        return Next("select", f"turned {np.degrees(turned):.0f} deg{gaps}")
    if c.handheld and b.scan_gaps <= _HANDHELD_GAPS:
        return Next("select", "looked all round")
    back = None if c.handheld else _relock(b)
    if back is not None:
        return back
    left = max(whole - turned, 0.1)
    slow = b.scan_turned_rad < b.scan_slow_until_rad
    rate = c.scan_rate_rad_s * (_SLOW_SHARE if slow else 1.0)
    return Intent("turn_left", "aim", Aim(_cruise(b), b.trajectory.yaw_rad + left + 0.2, 0.2, rate), left, "rad")


def _relock(b: Board) -> Intent | None:
    """Turn back to where slam was sure, when it falters; None while it does not, or where that did not help."""
    assert b.inputs.pose is not None
    inliers, c, t = b.inputs.pose.message.inliers, b.config, b.trajectory
    if inliers >= _SURE_TIMES * c.scan_falter_inliers:
        b.scan_sure_yaw_rad, b.relocking = t.yaw_rad, False
        if b.scan_turned_rad > b.relocked_at_rad + _NEW_PLACE_RAD:
            b.relocks = 0
    elif inliers < c.scan_falter_inliers and b.scan_sure_yaw_rad is not None and not b.relocking:
        b.relocked_at_rad = b.scan_turned_rad
        b.relocking, b.relocks = b.relocks < _RELOCKS, b.relocks + 1
        b.scan_slow_until_rad = b.scan_turned_rad + _SLOW_RAD
    if not b.relocking or b.scan_sure_yaw_rad is None:
        return None
    turn = b.scan_sure_yaw_rad - t.yaw_rad
    if abs(turn) < np.radians(1.0):
        b.relocking = False
        return None
    aim = Aim(_cruise(b), b.scan_sure_yaw_rad, 0.2, c.scan_rate_rad_s * _SLOW_SHARE)
    return Intent("turn_left" if turn > 0.0 else "turn_right", "aim", aim, abs(turn), "rad")


def select(b: Board, since_s: float) -> Result:
    """Entry: scan done, docked at one of several, or a target given up. Exit: a tree -> face; none -> return or land."""
    here, c = b.here, b.config
    if here is None or since_s < c.select_settle_s:
        return Intent("stop")
    done = {*b.visited_ids, *b.given_up_ids}
    if low := too_low_for_another(b) if done else unknown_word(b):
        return _go_home(b, low)
    b.claims.wait_only_for({t.id for t in b.trees} - done)
    closed = done | b.claims.closed_ids
    choice = choose(b.trees, here.position_m, closed, b.done_xy_m, c.select_confidence, b.wanted_id)
    if choice.tree is not None:
        return _claimed(b, choice)
    if b.claims.awaited and since_s < c.claims.wait_s:
        return _wait(b, since_s)
    if since_s < c.select_wait_s and not b.visited_ids and not b.claims.closed_words:
        return Intent("stop")
    return _go_home(b, "; ".join(word for word in (choice.reason, b.claims.awaited, b.claims.closed_words) if word))


def _wait(b: Board, since_s: float) -> Result:
    """Wait for a tree that another holds; not for ever where that other may be waiting for this place."""
    if since_s >= b.config.claims.give_way_s and b.home_known and b.from_home_m > _AWAY_M:
        b.giving_way = True
        return Next("return", f"giving way: {b.claims.awaited}")
    return Intent("stop", word=f"waiting: {b.claims.awaited}")


def _claimed(b: Board, choice: Choice) -> Result:
    """Take a tree that nobody else has; where claims are switched off, at once."""
    assert choice.tree is not None
    goal = tree_goal(b, choice.tree)
    if b.claims.on and goal is not None:
        by_order = b.wanted_id is not None
        answer = b.claims.want(goal, again=by_order)
        if answer == "refused" and by_order:
            b.wanted_id = None
        if answer != "held":
            waiting = b.claims.awaited
            return Intent("stop", word=f"waiting: {waiting}" if waiting else f"claiming tree {choice.tree.id}")
    b.choose(choice.tree)
    return Next("face", f"{choice.reason}; claimed" if b.claims.on else choice.reason)


def face(b: Board, since_s: float) -> Result:
    """Entry: a target chosen. Exit: it is ahead and tracked (or too far to be) -> approach; not seen -> select."""
    c, seen = b.config, b.to_axis()
    if b.axis_m is None or b.following.astray:
        return gone(b)
    if b.here is None or seen is None:
        return Intent("stop", "freeze")
    distance, bearing = seen
    still = abs(b.trajectory.yaw_rate_rad_s) < np.radians(2.0)
    if abs(bearing) < FACING_RAD and still:
        if not b.target_lost:
            return Next("approach", f"tree {b.target_id} in sight, {distance:.2f} m ahead")
        if b.hidden:
            return Next("approach", f"tree {b.target_id} is hidden behind a trunk: around it by the map")
        if distance > c.visual_range_m:
            return Next("approach", f"tree {b.target_id} is {distance:.2f} m ahead by the map: nearer to see it")
    if since_s > c.face_wait_s + np.pi / c.turn_rate_rad_s:
        return give_up(b, f"tree {b.target_id} is not seen where the map has it")
    aim = Aim(_cruise(b), yaw_to_axis(b), 0.3, c.turn_rate_rad_s)
    return Intent("turn_left" if bearing > 0.0 else "turn_right", "aim", aim, abs(bearing), "rad")


def dock(b: Board, since_s: float) -> Result:
    """Entry: within dock.enter_m. Exit: the 3 s window satisfies design.md section 5 -> docked; pushed off -> approach."""
    c, seen = b.config, b.to_axis()
    if b.axis_m is None or b.dock_direction is None:
        return Next("select", "the target is gone from the map")
    if b.here is None or seen is None:
        return Intent("stop", "freeze")
    distance, bearing = seen
    if b.following.astray:
        return Next("undock", b.following.astray)
    if distance > c.dock.leave_m:
        return Next("approach", f"pushed off to {distance:.2f} m")
    verdict = b.dock.verdict(float("inf") if c.handheld else since_s)
    if verdict.docked:
        b.finish_target(visited=True)
        return Next("docked", f"docked at tree {b.target_id}: {verdict.reason}")
    if since_s > c.dock.timeout_s:
        name = b.target_id
        b.finish_target(visited=False)
        return Next("undock", f"could not settle at tree {name}: {verdict.reason}")
    aim, gap = _station(b, distance, bearing), distance - c.dock.aim_m
    if abs(bearing) > (_CENTRED_RAD if abs(gap) < _GAP_M else TURN_FIRST_RAD):
        return Intent("turn_left" if bearing > 0.0 else "turn_right", "aim", aim, abs(bearing), "rad")
    if abs(gap) < _GAP_M:
        return Intent("stop", "aim", aim)
    return Intent("toward" if gap > 0.0 else "backward", "aim", aim, abs(gap), "m")


def docked(b: Board, since_s: float) -> Result:
    """Entry: docked. Exit: after dock.hold_s, more trees wanted -> undock; else return or landing."""
    seen = b.to_axis()
    if since_s >= b.config.dock.hold_s:
        if b.docked_count < b.trees_wanted and (low := too_low_for_another(b)):
            return _go_home(b, low)
        if b.docked_count < b.trees_wanted:
            return Next("undock", f"{b.docked_count} of {b.trees_wanted} trees done")
        return _go_home(b, f"{b.docked_count} of {b.trees_wanted} trees done")
    if seen is None or b.axis_m is None or b.dock_direction is None or b.target_lost:
        return Intent("docked", "brake" if b.here is not None else "freeze")
    return Intent("docked", "aim", _station(b, *seen))


def undock(b: Board, since_s: float) -> Result:
    """Entry: leaving a trunk. Exit: undock_m away -> select, or return when enough are done."""
    c, here = b.config, b.here
    if here is None:
        return Intent("stop", "freeze")
    if b.axis_m is None or b.dock_direction is None:
        return Next("select", "the target is gone from the map")
    left = c.undock_m - float(np.linalg.norm(here.position_m[:2] - b.axis_m))
    if b.claims.leaving and (left < 0.1 or since_s > _LEAVE_WITHIN_S):
        return Next("landing", "clear of the trunk, without a claim")
    if left < 0.1 or since_s > 20.0:
        b.drop_target()
        if b.docked_count >= b.trees_wanted or b.homeward:
            return _go_home(b, "clear of the trunk")
        return Next("select", "clear of the trunk")
    goal = at_height(b, b.axis_m + b.dock_direction * c.undock_m)
    return Intent("backward", "aim", Aim(goal, b.trajectory.yaw_rad, 0.3, 0.0), max(left, 0.0), "m")


def return_home(b: Board, since_s: float) -> Result:
    """Entry: the trees wanted are done, or giving way. Exit: over the start -> landing, having given way -> select.

    No way or too long -> landing here.
    """
    here = b.here
    if here is None:
        return Intent("stop", "freeze")
    if b.home_m is None or not b.home_known:
        return Next("landing", "the start is not known in this map")
    left = b.from_home_m
    over = left < _OVER_START_M
    still = float(np.linalg.norm(b.trajectory.velocity_m_s)) < _SETTLED_M_S
    b.over_start_s = b.over_start_s + b.dt_s if over and still else 0.0
    if over and b.giving_way:
        b.giving_way = False
        return Next("select", "gave way: asking on from the start")
    if b.over_start_s > (_STILL_S if left < _AT_START_M else _SETTLE_S):
        return Next("landing", f"back at the start within {left:.2f} m")
    if b.claims.on:
        goal = home_goal(b)
        if goal is not None and b.claims.want(goal) != "held":
            if b.claims.waited_s > b.config.claims.wait_s:
                return Next("landing", f"no free way back: landing {left:.1f} m from the start: {b.claims.word}")
            return Intent("stop", word=f"claiming the way back: {b.claims.word}")
    way = route(b, b.trajectory.position_m[:2], b.home_m[:2])
    if way is None or since_s > 120.0:
        return Next("landing", f"no way back: landing {left:.1f} m from the start")
    ahead = way[0] - here.position_m[:2]
    yaw = b.trajectory.unwrapped(float(np.arctan2(ahead[1], ahead[0]))) if left > 0.7 else b.trajectory.yaw_rad
    turn = wrap_angle(yaw - here.yaw_rad)
    if abs(turn) > np.radians(30.0):
        aim = Aim(at_height(b, b.trajectory.position_m[:2]), yaw, 0.1, b.config.turn_rate_rad_s)
        return Intent("turn_left" if turn > 0.0 else "turn_right", "aim", aim, abs(turn), "rad")
    aim = Aim(at_height(b, way[0]), yaw, b.config.motion.max_speed_m_s, b.config.turn_rate_rad_s)
    return Intent("toward", "aim", aim, left, "m")


STATES: dict[MissionStateName, Callable[[Board, float], Result]] = {
    "take_off": take_off, "scan": scan, "select": select, "face": face, "approach": approach, "dock": dock,
    "docked": docked, "undock": undock, "return": return_home,
}  # fmt: skip


def _go_home(b: Board, reason: str) -> Next:
    if b.config.handheld:
        return Next("landed", reason)
    if b.config.return_home or b.trees_wanted > 1:
        b.homeward, b.giving_way = True, False
        if b.axis_m is not None and b.dock_direction is not None:
            return Next("undock", f"{reason}: away from the trunk first")
        return Next("return", reason)
    return Next("landing", reason)


def _cruise(b: Board) -> Matrix:
    """Return the place to hover at: where the setpoint is, at flight height."""
    return at_height(b, b.trajectory.position_m[:2])


def _station(b: Board, distance_m: float, bearing_rad: float) -> Aim:
    """Return the aim in front of the trunk, with the slow correction of standing offsets."""
    c = b.config
    assert b.axis_m is not None
    assert b.dock_direction is not None
    settled = float(np.linalg.norm(b.trajectory.velocity_m_s)) < _SETTLED_M_S
    if settled and b.target is not None and b.target.measured:
        gain, limit = c.dock.integral_per_s * b.dt_s, c.dock.integral_limit_m
        standing = float(np.linalg.norm(b.trajectory.position_m[:2] - b.axis_m)) - distance_m
        b.dock_offset_m = float(np.clip(b.dock_offset_m + gain * (standing - b.dock_offset_m), -limit, limit))
        turned = b.dock_yaw_rad + _YAW_INTEGRAL_SHARE * gain * bearing_rad
        b.dock_yaw_rad = float(np.clip(turned, -_YAW_CORRECTION_RAD, _YAW_CORRECTION_RAD))
    place = b.axis_m + b.dock_direction * (c.dock.aim_m + b.dock_offset_m)
    return Aim(at_height(b, place), yaw_to_axis(b) + b.dock_yaw_rad, 0.2, c.turn_rate_rad_s, c.approach_gain_per_s)
