"""A flown mission in figures: what it believed beside what was true, and the chain's errors on the way. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any, Protocol

import numpy as np

from schemas.navigation import MissionState
from schemas.simulation import SimTruth, TrueTree
from schemas.slam import Pose
from schemas.trees import Target
from services.common.geometry import Matrix, camera_yaw, from_transform, log_rotation, wrap_angle

WINDOW_S = 3.0
MIN_M, MAX_M = 0.85, 1.00
_SAME_TREE_M, _CLOSE_M = 0.5, 1.5
MAX_HEADING_RAD = math.radians(3.0)


class Record(Protocol):
    """What was said during a flight, in order of arrival."""

    states: list[MissionState]
    poses: list[Pose]
    targets: list[Target]
    truths: list[SimTruth]


def mission_figures(record: Record, trees_wanted: int = 1) -> dict[str, Any]:
    """Return how a mission ended: state, reason, each docking believed and true, touches, clearance, events.

    ``docked``: at as many trees as were wanted, each of them well.
    """
    states = record.states
    last = states[-1] if states else None
    docks = [_dock(record, state) for state in _entered(states, "docked")]
    values: dict[str, Any] = {
        "state": last.state if last else "idle",
        "reason": last.reason if last else "never started",
        "docked": len(docks) >= max(trees_wanted, 1) and all(dock["good"] for dock in docks),
        "docks": docks,
        "events": [{"s": round(s.since_ns * 1e-9, 2), "state": s.state, "reason": s.reason} for s in _events(states)],
    }
    if record.truths:
        truth = record.truths[-1]
        values |= {
            "touches": truth.touched, "clearance_m": round(truth.clearance_m, 3),
            "simulated_s": round((truth.stamp_ns - record.truths[0].stamp_ns) * 1e-9, 1),
            "errors": chain_errors(record),
        }  # fmt: skip
    return values


def _events(states: Sequence[MissionState]) -> list[MissionState]:
    """Return the first message of each state."""
    first = [states[0]] if states else []
    return first + [b for a, b in pairwise(states) if (a.state, a.since_ns) != (b.state, b.since_ns)]


def _entered(states: Sequence[MissionState], name: str) -> list[MissionState]:
    """Return where a state was come upon; a hold in between does not count it again."""
    found: list[MissionState] = []
    for state in _events(states):
        if state.state == name and (not found or state.docked_count > found[-1].docked_count):
            found.append(state)
    return found


def _dock(record: Record, docked: MissionState) -> dict[str, Any]:
    """Return one docking: means over the window before it was believed, to the nearest true trunk."""
    begin_ns, end_ns = docked.since_ns - round(WINDOW_S * 1e9), docked.since_ns
    seen = [t for t in record.targets if begin_ns <= t.stamp_ns <= end_ns and t.measured]
    values: dict[str, Any] = {
        "tree_id": docked.target_tree_id,
        "distance_m": _mean(t.range_m for t in seen if t.range_m is not None),
        "heading_deg": _mean(math.degrees(t.bearing_rad) for t in seen if t.bearing_rad is not None),
    }
    true = [t for t in record.truths if begin_ns <= t.stamp_ns <= end_ns]
    if not true:
        return values | {"good": True}
    cameras = [from_transform(t.T_map_camera) for t in true]
    trees = true[-1].trees
    index = int(np.argmin([to_axis(cameras[-1], tree)[0] for tree in trees])) if trees else None
    if index is None:
        return values | {"good": False}
    measured = np.array([to_axis(T, trees[index]) for T in cameras])
    distance, heading = float(measured[:, 0].mean()), float(measured[:, 1].mean())
    good = MIN_M <= distance <= MAX_M and abs(heading) <= MAX_HEADING_RAD and trees[index].suitable
    return values | {
        "true_tree": index, "true_distance_m": round(distance, 4), "true_heading_deg": round(math.degrees(heading), 2),
        "good": good,
    }  # fmt: skip


def to_axis(T_map_camera: Matrix, tree: TrueTree) -> tuple[float, float]:
    """Return horizontal distance (m) and bearing (rad, positive left) from a camera to a trunk's axis at its height."""
    camera = T_map_camera[:3, 3]
    share = (camera[2] - tree.z_m) / tree.axis[2]
    offset = np.array([tree.x_m + share * tree.axis[0], tree.y_m + share * tree.axis[1]]) - camera[:2]
    bearing = wrap_angle(math.atan2(float(offset[1]), float(offset[0])) - camera_yaw(T_map_camera))
    return float(np.linalg.norm(offset)), bearing


def _mean(values: Iterable[float]) -> float | None:
    numbers = list(values)
    return round(float(np.mean(numbers)), 4) if numbers else None


def chain_errors(record: Record) -> dict[str, float]:
    """Return the errors of pose and target against the truth at the same stamps: RMSE, mean, maximum.

    ``*_white`` is the part that changes from frame to frame: the RMS of the differences of successive errors, over
    the root of two.
    """
    truths = {t.stamp_ns: t for t in record.truths}
    lost = sum(p.T_map_camera is None for p in record.poses)
    figures: dict[str, float] = {"frames": len(record.truths), "poses": len(record.poses), "poses_lost": lost}
    for name, errors in {**_pose_errors(record.poses, truths), **_target_errors(record.targets, truths)}.items():
        if not errors:
            continue
        e = np.array(errors).reshape(len(errors), -1)
        size = np.linalg.norm(e, axis=1)
        figures[f"{name}_rmse"] = round(float(np.sqrt(np.mean(size**2))), 4)
        figures[f"{name}_max"] = round(float(size.max()), 4)
        if e.shape[1] == 1:
            figures[f"{name}_mean"] = round(float(e.mean()), 4)
        if len(e) > 1:
            steps = np.diff(e, axis=0)
            figures[f"{name}_white"] = round(float(np.sqrt(np.mean(np.sum(steps**2, axis=1)) / 2.0)), 4)
    return figures


def _pose_errors(poses: Iterable[Pose], truths: dict[int, SimTruth]) -> dict[str, list[Any]]:
    """Return the errors of tracked poses: position in map (m, 3), yaw and tilt (degrees)."""
    found: dict[str, list[Any]] = {"pose_m": [], "yaw_deg": [], "tilt_deg": []}
    for p in poses:
        true = truths.get(p.stamp_ns)
        if true is None or p.T_map_camera is None:
            continue
        T, T_true = from_transform(p.T_map_camera), from_transform(true.T_map_camera)
        turn = np.degrees(log_rotation(T[:3, :3] @ T_true[:3, :3].T))
        found["pose_m"].append(T[:3, 3] - T_true[:3, 3])
        found["yaw_deg"].append(float(turn[2]))
        found["tilt_deg"].append(float(np.linalg.norm(turn[:2])))
    return found


def _target_errors(targets: Iterable[Target], truths: dict[int, SimTruth]) -> dict[str, list[Any]]:
    """Return errors of range (m) and bearing (deg) of measured frames against the trunk they fit best, within 0.5 m.

    ``close_*``: the same within 1.5 m, where docking is decided.
    """
    found: dict[str, list[Any]] = {"range_m": [], "bearing_deg": [], "close_range_m": [], "close_bearing_deg": []}
    for t in targets:
        true = truths.get(t.stamp_ns)
        if true is None or not t.measured or t.range_m is None or t.bearing_rad is None:
            continue
        T = from_transform(true.T_map_camera)
        places = [to_axis(T, tree) for tree in true.trees]
        fits = [(math.hypot(d - t.range_m, d * (b - t.bearing_rad)), d, b) for d, b in places]
        off, d, b = min(fits, default=(math.inf, 0.0, 0.0))
        if off > _SAME_TREE_M:
            continue
        for prefix in ("", "close_") if d < _CLOSE_M else ("",):
            found[f"{prefix}range_m"].append(t.range_m - d)
            found[f"{prefix}bearing_deg"].append(math.degrees(wrap_angle(t.bearing_rad - b)))
    return found
