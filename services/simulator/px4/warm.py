"""Compiles or loads every kernel of the simulated autopilot with tiny inputs."""

from __future__ import annotations

import math

import numpy as np

from services.simulator.px4.config import Px4Config
from services.simulator.px4.vehicle import Vehicle
from services.simulator.px4.vision import VisionSample


def warm() -> None:
    """Fly a fifth of a second in memory with vision, so that every kernel has run once."""
    start = np.eye(4)
    start[2, 3] = 0.1
    vehicle = Vehicle(lambda _x, _y: 0.0, start, Px4Config(parameters={"EKF2_DELAY_MAX": 20.0}), 0, lambda _s, _t: None)
    for tick in range(60):
        if tick % 8 == 0:
            unknown = np.full(3, math.nan)
            sample = VisionSample(
                vehicle.now_s, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), unknown, unknown, math.nan, unknown,
                frame_is_ned=True, reset_counter=0,
            )  # fmt: skip
            vehicle.estimator.add_vision(sample, vehicle.now_s)
        vehicle.step()
    vehicle.spin_once()
