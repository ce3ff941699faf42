"""The live guard's eyes on rendered depth: people are found where they stand, and nothing where nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from services.common.geometry import inverse, level_camera
from services.navigator.guard import look
from services.navigator.path import Disc
from services.navigator.space import Space
from services.simulator.config import SimulatorConfig
from services.simulator.path import map_frame
from services.simulator.stage import Stage


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "people"), [(2, 0), (3, 1)])
def test_a_turn_on_the_spot_finds_people_and_no_phantoms(seed: int, people: int) -> None:
    stage, space = Stage(SimulatorConfig(seed=seed, reduced=True)), Space()
    T_world_map = map_frame(stage.path.at(0.0))
    T_map_world = inverse(T_world_map)

    def place(p: np.ndarray) -> tuple[float, float]:
        x_m, y_m, *_ = T_map_world @ np.array([*p, 1.0])
        return float(x_m), float(y_m)

    known = [Disc(*place(t.centre_at(1.5)), t.radius_m + 0.3) for t in stage.scene.trees]
    for n in range(36):
        T = level_camera((0.0, 0.0, 1.4), n * 2.0 * np.pi / 36)
        frame = stage.frame(T_world_map @ T, np.zeros(3), n, n * 10**8)
        depth = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.intrinsics.height, frame.intrinsics.width)
        for _ in range(3):
            space.take(look(depth, frame.intrinsics, T, n, ("m", 0)), known)
    things = space.things()
    assert len(things) == people == len(stage.scene.people)
    for thing, person in zip(things, stage.scene.people, strict=True):
        assert np.hypot(*(np.array([thing.x_m, thing.y_m]) - place(np.array([person.x_m, person.y_m, 0.0])))) < 0.35
    angles = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    assert space.is_free(1.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)).all()
