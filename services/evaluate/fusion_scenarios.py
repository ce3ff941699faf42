"""Scenarios of the fusion's benchmark: how it is flown, by whom the camera is located, what goes wrong."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from services.common.geometry import Matrix
from services.evaluate.bench import code_version
from services.evaluate.bench_catalogue import _SIMULATOR
from services.evaluate.fusion_flight import FRAME_HZ, FlownWay, Way, fly
from services.evaluate.fusion_model import located_by_model
from services.evaluate.fusion_rendered import FIRST, SECOND, SECONDS, circle, see
from services.evaluate.fusion_run import Judged, judge, run_fusion, vision_on_earth
from services.evaluate.slam_turns import mean_alignment
from services.evaluate.slam_walk import walk_scene
from services.fusion.config import FusionConfig, SecondCameraConfig
from services.fusion.values import Located
from services.simulator.px4.config import GpsConfig, WindConfig

_TWO = SecondCameraConfig(enabled=True)
SETUPS: dict[str, FusionConfig] = {
    "vision only": FusionConfig(imu=False),
    "+ IMU": FusionConfig(),
    "+ GPS": FusionConfig(imu=False, gps=True),
    "+ IMU + GPS": FusionConfig(gps=True),
    "+ second camera": FusionConfig(imu=False, second=_TWO),
    "+ IMU + second camera": FusionConfig(second=_TWO),
}
_ALIGNED = 45
"""Slam's map is laid on the truth by its first three seconds."""
_CALM, _GUSTY = WindConfig(), WindConfig(mean_m_s=3.0, gust_m_s=2.0, gust_time_s=1.2)
_RENDERED_CODE = ("services.slam", *_SIMULATOR, "services.evaluate.fusion_rendered", "services.evaluate.fusion_flight")


@dataclass(frozen=True, slots=True)
class Scenario:
    """One kind of flight."""

    name: str
    about: str
    seconds: float
    wind: WindConfig = _CALM
    gps: GpsConfig = field(default_factory=lambda: GpsConfig(present=True))
    dark_s: tuple[tuple[float, float], ...] = ()
    """When the first camera is covered (by the model)."""
    fault: str = ""
    """Of the rendered flights: the fault of the first camera; empty: by the model."""
    seeds: int = 2
    setups: tuple[str, ...] = tuple(SETUPS)


def _every(period_s: float, for_s: float, until_s: float) -> tuple[tuple[float, float], ...]:
    return tuple((t, t + for_s) for t in np.arange(period_s, until_s - for_s, period_s))


_GPS_SETUPS = ("vision only", "+ GPS", "+ IMU + GPS")
_LIES_S, _LIED_S = 45.0, 100.0
SCENARIOS: tuple[Scenario, ...] = (
    Scenario("blackout", "lens covered for 0.5, 1, 2 and 4 s", SECONDS, fault="blackout"),
    Scenario("low texture", "fog for 2, 4 and 1 s: a tenth of the contrast, depth to 2 m", SECONDS, fault="low texture"),
    Scenario("gust", "wind 3 m/s, gusts of 2 m/s; covered for 1 s every 10 s", 60.0, _GUSTY, dark_s=_every(10.0, 1.0, 60.0),
             setups=("vision only", "+ IMU", "+ second camera", "+ IMU + second camera")),
    Scenario("long walk", "120 m; covered for 2 s every 60 s", 240.0, dark_s=_every(60.0, 2.0, 240.0),
             setups=("vision only", "+ IMU", "+ GPS", "+ IMU + GPS")),
    Scenario("GPS jump", "by 10 m after 45 s", _LIED_S, gps=GpsConfig(present=True, jump_at_s=_LIES_S), dark_s=_every(50.0, 1.0, _LIED_S),
             setups=_GPS_SETUPS),
    Scenario("GPS drag", "by 0.18 m/s from 45 s on", _LIED_S, gps=GpsConfig(present=True, drag_from_s=_LIES_S),
             dark_s=_every(50.0, 1.0, _LIED_S), setups=_GPS_SETUPS),
    Scenario("GPS honest", "the same without a lie", _LIED_S, dark_s=_every(50.0, 1.0, _LIED_S), setups=_GPS_SETUPS),
)  # fmt: skip


def oval(t_s: float) -> tuple[Matrix, float]:
    """Return the way of the flights by the model: a circle of 9 m with a wave in it, half a metre a second."""
    angle = 0.5 * t_s / 9.0
    p = [9.0 * math.sin(angle), 9.0 * (1.0 - math.cos(angle)) + math.sin(t_s / 9.0), 1.5 + 0.2 * math.sin(t_s / 6.0)]
    return np.array(p), angle + 0.3 * math.sin(t_s / 5.0)


@dataclass(frozen=True, slots=True)
class Flight:
    """A scenario flown once."""

    flown: FlownWay
    first: Sequence[Located | None]
    second: Sequence[Located | None]
    A: Matrix
    """Slam's map to the world."""


def make(scenario: Scenario, seed: int, kept: Path, tell: Callable[[str], None]) -> Flight:
    """Fly a scenario; rendered ones are located by the real slam, which takes minutes the first time."""
    if scenario.fault:
        flown = fly(circle(walk_scene(seed)), scenario.seconds, seed, scenario.wind, scenario.gps)
        seen = see(flown, seed, kept / f"seen-{seed}-{code_version(_RENDERED_CODE)}", tell)
        first = seen[scenario.fault].located(flown)
        return Flight(flown, first, seen["second"].located(flown), _alignment(flown, first))
    way: Way = oval
    flown = fly(way, scenario.seconds, seed, scenario.wind, scenario.gps)

    def lost(index: int) -> bool:
        return any(a <= index / FRAME_HZ < b for a, b in scenario.dark_s)

    first = located_by_model(flown.frames, FIRST, lost, seed)
    second = [
        None if place is None else replace(place, epoch=("second", place.epoch[1]))
        for place in located_by_model(flown.frames, SECOND, lambda _: False, seed + 1000)
    ]
    return Flight(flown, first, second, _alignment(flown, first))


def _alignment(flown: FlownWay, first: Sequence[Located | None]) -> Matrix:
    pairs = [
        (located.T_map_camera, frame.T_world_body @ FIRST)
        for frame, located in zip(flown.frames[:_ALIGNED], first, strict=False)
        if located is not None
    ]
    return mean_alignment([mine for mine, _ in pairs], [true for _, true in pairs])


def measure(flight: Flight, setup: str, after_s: float) -> dict[str, Any]:
    """Run one set-up over a flight and return its row; ``after_s``: from then on the place on the earth counts."""
    begin = time.process_time()
    heard, fuser = run_fusion(flight.flown, flight.first, flight.second, SETUPS[setup], FIRST, SECOND)
    spent_s = time.process_time() - begin
    judged = judge(flight.flown, heard, FIRST, flight.A, 1.0 / FRAME_HZ)
    row = _errors(judged)
    if setup == "vision only":
        earth = vision_on_earth(flight.flown, flight.first, FIRST, flight.A)
        row |= _on_earth(earth, round(after_s * FRAME_HZ))
    elif fuser.gps is not None:
        row |= _on_earth(judged.earth_m, len(judged.earth_m) - len(heard) + round(after_s * FRAME_HZ))
        told_s = _caught_s(fuser.gps.caught_ns, flight.flown)
        row |= {"caught_s": told_s, "used": fuser.gps.used, "refused": fuser.gps.refused}
    row |= {
        "ms": round(1e3 * spent_s / len(heard), 3),
        "restarts": fuser.restarts,
        "contradicted": fuser.guard.contradicted,
    }
    return row


def _caught_s(caught_ns: Sequence[int], flown: FlownWay) -> list[float]:
    return [round((ns - flown.frames[0].stamp_ns) * 1e-9, 1) for ns in caught_ns]


def _errors(judged: Judged) -> dict[str, Any]:
    carried = judged.carried_m
    return {
        "rmse_m": round(float(np.sqrt(np.mean(judged.position_m**2))), 4),
        "worst_m": round(float(judged.position_m.max()), 4),
        "yaw_deg": round(float(np.degrees(judged.yaw_rad.max())), 3),
        "without_s": round(judged.without_s, 2),
        "carried_s": round(len(carried) / FRAME_HZ, 2),
        "carried_worst_m": round(float(carried.max()), 4) if len(carried) else None,
        "nees": round(float(judged.nees.mean()), 3) if len(carried) else None,
    }


def _on_earth(errors_m: Matrix, first: int) -> dict[str, Any]:
    """Return figures of the horizontal errors on the earth from frame ``first`` on."""
    counted = errors_m[max(first, 0) :]
    if not len(counted):
        return {}
    return {
        "earth_rmse_m": round(float(np.sqrt(np.mean(counted**2))), 3),
        "earth_worst_m": round(float(counted.max()), 3),
        "earth_end_m": round(float(counted[-1]), 3),
    }
