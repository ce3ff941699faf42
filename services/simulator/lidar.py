"""A spinning LiDAR: beams at fixed elevations all round, noise along the beam, no image.

Figures: Velodyne's VLP-16 (docs/sensors.md). What the beam's width does at edges is left out: at 6 m it is 2 cm wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from services.simulator.scene import Floats
from services.simulator.world import Floats32, World


@dataclass(frozen=True, slots=True)
class LidarModel:
    """Beams and noise."""

    beams: int = 16
    lowest_deg: float = -15.0
    highest_deg: float = 15.0
    azimuth_step_deg: float = 0.2
    """At ten turns a second."""
    range_sigma_m: float = 0.03
    min_range_m: float = 0.5
    max_range_m: float = 100.0


class Lidar:
    """A LiDAR in a world, mounted level where the camera would be: its axes are the camera's (right, down, forward)."""

    def __init__(self, world: World, model: LidarModel, seed: int = 0) -> None:
        self._world, self._model, self._seed = world, model, seed
        elevation = np.radians(np.linspace(model.lowest_deg, model.highest_deg, model.beams))
        azimuth = np.radians(np.arange(0.0, 360.0, model.azimuth_step_deg))
        e, a = np.meshgrid(elevation, azimuth, indexing="ij")
        directions = np.stack([np.cos(e) * np.sin(a), -np.sin(e), np.cos(e) * np.cos(a)], axis=-1)
        self._directions: Floats = directions.reshape(-1, 3)
        """(N, 3) unit, sensor frame."""

    def scan(self, T_world_sensor: Floats, seq: int) -> Floats32:
        """Return the points (M, 3) of one turn, sensor frame; ``seq`` draws the noise. The turn takes no time."""
        rays = np.empty((len(self._directions), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = T_world_sensor[:3, 3], self._directions @ T_world_sensor[:3, :3].T
        distance = self._world.cast(rays).distance.astype(np.float64)
        rng = np.random.default_rng([self._seed, 304, seq])
        distance += rng.normal(0.0, self._model.range_sigma_m, len(distance))
        good = np.isfinite(distance) & (distance >= self._model.min_range_m) & (distance <= self._model.max_range_m)
        return np.asarray(self._directions[good] * distance[good, None], dtype=np.float32)
