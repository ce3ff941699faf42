"""Compiles the simulator's kernels."""

from __future__ import annotations

import numpy as np

from services.simulator.camera import SimulatedCamera
from services.simulator.config import SensorConfig
from services.simulator.scene import Scene
from services.simulator.world import World


def warm() -> None:
    """Compile (or load from the cache) every kernel by one frame of an empty scene, at both sizes."""
    world = World(Scene("empty", 0, ()))
    looking_along_x = np.array(
        [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
    )
    for reduced in (False, True):
        SimulatedCamera(world, SensorConfig(), reduced).look(looking_along_x, 0)
