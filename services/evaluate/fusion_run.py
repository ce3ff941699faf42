"""Fusion over a flown way, event by event as they would arrive, and what came out of it against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix, inverse, log_rotation
from services.evaluate.fusion_flight import EARTH_FROM_WORLD, FlownWay
from services.fusion.config import FusionConfig
from services.fusion.fuser import Fuser
from services.fusion.values import Fused, Located

_IMU_LATE_NS, _SLAM_LATE_NS, _SECOND_LATE_NS, _GPS_LATE_NS = 10_000_000, 35_000_000, 40_000_000, 120_000_000


@dataclass(frozen=True, slots=True)
class Heard:
    """What was told at one frame."""

    fused: Fused | None
    on_earth_m: Matrix | None
    """The body on the earth (east, north, up), and its sigma."""
    earth_sigma_m: float


def run_fusion(
    flown: FlownWay,
    first: Sequence[Located | None],
    second: Sequence[Located | None] | None,
    config: FusionConfig,
    T_body_camera: Matrix,
    T_body_second: Matrix | None,
) -> tuple[list[Heard], Fuser]:
    """Feed a flight to fusion; returns what it told at each frame, and the fuser for a look at its counters."""
    fuser = Fuser(config, T_body_camera, T_body_second if config.second.enabled else None)
    events: list[tuple[int, int, int]] = []
    events += [(r.stamp_ns + _IMU_LATE_NS, 0, k) for k, r in enumerate(flown.imu)]
    events += [(f.stamp_ns + _GPS_LATE_NS, 1, k) for k, f in enumerate(flown.fixes)]
    events += [(f.stamp_ns + _SLAM_LATE_NS, 2, k) for k, f in enumerate(flown.frames)]
    if second is not None and config.second.enabled:
        events += [(f.stamp_ns + _SECOND_LATE_NS, 3, k) for k, f in enumerate(flown.frames)]
    heard = [Heard(None, None, np.inf)] * len(flown.frames)
    for _, kind, k in sorted(events):
        if kind == 0:
            fuser.imu(flown.imu[k])
        elif kind == 1:
            fuser.fix(flown.fixes[k])
        elif kind == 2:
            heard[k] = _heard(fuser.camera(flown.frames[k].stamp_ns, first[k]), fuser)
        elif second is not None:
            fused = fuser.second(flown.frames[k].stamp_ns, second[k])
            heard[k] = _heard(fused, fuser) if fused is not None else heard[k]
    return heard, fuser


def _heard(fused: Fused | None, fuser: Fuser) -> Heard:
    place = fuser.on_earth()
    return Heard(fused, None, np.inf) if place is None else Heard(fused, place[0], place[2])


@dataclass(frozen=True, slots=True)
class Judged:
    """Errors of one run, and seconds without a pose."""

    position_m: Matrix
    """(N,) of the told poses."""
    yaw_rad: Matrix
    without_s: float
    carried_m: Matrix
    """By how much the poses that no first camera stood behind had moved wrongly since the last one it did."""
    nees: Matrix
    """Their squared error over their told covariance, position only (3 degrees of freedom)."""
    earth_m: Matrix
    """Horizontal errors on the earth from the moment on at which the heading was known."""


def judge(flown: FlownWay, heard: Sequence[Heard], T_body_camera: Matrix, A: Matrix, frame_s: float) -> Judged:
    """Judge what was told; ``A`` takes slam's map to the world."""
    position, yaw, carried, nees, earth = [], [], [], [], []
    by_camera: tuple[Matrix, Matrix] | None = None
    for frame, h in zip(flown.frames, heard, strict=True):
        if h.on_earth_m is not None:
            earth_m = EARTH_FROM_WORLD @ frame.T_world_body[:3, 3]
            earth.append(float(np.linalg.norm((h.on_earth_m - earth_m)[:2])))
        if h.fused is None:
            continue
        T, true_T = A @ h.fused.T_map_camera, frame.T_world_body @ T_body_camera
        position.append(float(np.linalg.norm(T[:3, 3] - true_T[:3, 3])))
        yaw.append(float(abs(log_rotation(T[:3, :3] @ true_T[:3, :3].T)[2])))
        if h.fused.carrier == "camera":
            by_camera = T, true_T
        elif by_camera is not None:
            error = T[:3, 3] - (by_camera[0] @ inverse(by_camera[1]) @ true_T)[:3, 3]
            carried.append(float(np.linalg.norm(error)))
            C = A[:3, :3] @ h.fused.covariance[:3, :3] @ A[:3, :3].T
            nees.append(float(error @ np.linalg.solve(C, error)))
    missing = sum(h.fused is None for h in heard)
    return Judged(
        np.array(position), np.array(yaw), missing * frame_s, np.array(carried), np.array(nees), np.array(earth)
    )


def vision_on_earth(flown: FlownWay, first: Sequence[Located | None], T_body_camera: Matrix, A: Matrix) -> Matrix:
    """Return vision's horizontal errors on the earth where it was located, had its start been placed without any error."""
    T_camera_body = inverse(T_body_camera)
    return np.array(
        [
            float(np.linalg.norm((A @ located.T_map_camera @ T_camera_body - frame.T_world_body)[:2, 3]))
            for frame, located in zip(flown.frames, first, strict=True)
            if located is not None
        ]
    )
