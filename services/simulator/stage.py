"""The scene with its camera, and the truth about both: what every mode of the simulator shows and tells."""

from __future__ import annotations

import numpy as np

from schemas.camera import RgbdFrame
from schemas.simulation import SimTruth
from services.common.geometry import inverse, to_transform
from services.simulator.camera import SimulatedCamera
from services.simulator.catalogue import scene_for
from services.simulator.config import SimulatorConfig
from services.simulator.path import map_frame, reference_path
from services.simulator.scene import Floats
from services.simulator.sensor import Accelerometer
from services.simulator.touch import Touches
from services.simulator.truth import fair_trees, truth_trees
from services.simulator.world import World

_SECOND_SEED = 5_000
_ACCEL_READINGS = 6
"""Readings per frame; the frame carries their mean."""


class Stage:
    """A world seen by a camera. Frames and truths are made of true poses, ``T_world_camera`` (4, 4)."""

    def __init__(self, config: SimulatorConfig, *, second: bool = False) -> None:
        scene = scene_for(config.scene, config.seed, config.trees)
        self.scene = scene
        self.world = World(scene)
        self.path = reference_path(scene, config.path, self.world.clearance)
        """The scripted path; also flown aircraft are judged by what could be seen from it."""
        self.touches = Touches(config.body_radius_m)
        self._camera = SimulatedCamera(self.world, config.sensor, config.reduced, config.seed, config.small)
        self._accelerometer = Accelerometer(config.sensor, config.seed)
        other_seed = config.seed + _SECOND_SEED
        self._second = (
            SimulatedCamera(self.world, config.sensor, config.reduced, other_seed, config.small) if second else None
        )
        self._second_accelerometer = Accelerometer(config.sensor, other_seed)
        self._T_map_world = np.eye(4)
        self._fair = fair_trees(self.world, self.path)
        self.begin_map(self.path.at(0.0))
        self._camera.look(self.path.at(0.0), 0)  # compiles: a work loop that does it later passes for hung

    def begin_map(self, T_world_camera: Floats) -> None:
        """Lay the map frame at the first camera pose."""
        T_world_map = map_frame(T_world_camera)
        self._T_map_world = inverse(T_world_map)
        self._trees = truth_trees(self.scene, T_world_map, self._fair)

    def frame(self, T_world_camera: Floats, acceleration: Floats, seq: int, stamp_ns: int) -> RgbdFrame:
        """Return what the camera sees; ``acceleration`` in the world, m/s^2 (3,), gravity not included."""
        return _frame(self._camera, self._accelerometer, T_world_camera, acceleration, seq, stamp_ns)

    def second_frame(self, T_world_camera: Floats, acceleration: Floats, seq: int, stamp_ns: int) -> RgbdFrame | None:
        """Return what the second camera sees at its own pose, None without one."""
        if self._second is None:
            return None
        return _frame(self._second, self._second_accelerometer, T_world_camera, acceleration, seq, stamp_ns)

    def truth(self, T_world_camera: Floats, seq: int, stamp_ns: int) -> SimTruth:
        """Return the truth at a pose."""
        return SimTruth(
            stamp_ns=stamp_ns, seq=seq, scene=self.scene.name,
            T_map_camera=to_transform(self._T_map_world @ T_world_camera), trees=self._trees,
            touched=self.touches.count, clearance_m=min(self.touches.smallest_m, 1e3),
        )  # fmt: skip


def _frame(
    camera: SimulatedCamera, accelerometer: Accelerometer, T_world_camera: Floats, acceleration: Floats, seq: int,
    stamp_ns: int,
) -> RgbdFrame:  # fmt: skip
    images = camera.look(T_world_camera, seq)
    readings = [accelerometer.measure(T_world_camera[:3, :3], acceleration) for _ in range(_ACCEL_READINGS)]
    x, y, z = (float(value) for value in np.mean(readings, axis=0))
    return RgbdFrame(
        stamp_ns=stamp_ns, seq=seq, intrinsics=camera.intrinsics, colour=images.colour.data.cast("B"),
        depth=images.depth.data.cast("B"), render_scale=camera.render_scale, accel_camera=(x, y, z),
    )  # fmt: skip
