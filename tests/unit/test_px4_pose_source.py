"""The camera on the simulated aircraft."""

from __future__ import annotations

import numpy as np
import pytest

from services.common.geometry import camera_yaw, pose, rotation_z
from services.common.mount import Mount
from services.simulator.px4.config import Px4Config
from services.simulator.px4.pose_source import SLICE_S, FlyingCamera
from services.simulator.px4.simulated import SimulatedPx4


def standing(
    yaw_rad: float = 0.5, offset_m: tuple[float, float, float] = (0.05, 0.0, -0.02), pitch_rad: float = 0.0
) -> FlyingCamera:
    px4 = SimulatedPx4(lambda _x, _y: 0.3, pose(rotation_z(yaw_rad), [1.0, 2.0, 0.4]), Px4Config(), 1)
    return FlyingCamera(px4, Mount.level(offset_m, pitch_rad))


def test_camera_looks_forward_from_its_place_on_the_body() -> None:
    c = standing()
    T = c.pose()
    assert camera_yaw(T) == pytest.approx(0.5)
    assert np.allclose(T[:3, 3], rotation_z(0.5) @ [0.05, 0.0, -0.02] + [1.0, 2.0, 0.4])


def test_a_camera_that_is_mounted_looking_down_looks_down() -> None:
    forward = standing(pitch_rad=0.3).pose()[:3, 2]
    assert forward[2] == pytest.approx(-np.sin(0.3))
    assert np.arctan2(forward[1], forward[0]) == pytest.approx(0.5)


def test_standing_it_neither_moves_nor_accelerates_nor_ends() -> None:
    c = standing()
    before = c.pose()
    c.advance(1.0)
    assert np.allclose(c.pose(), before, atol=1e-3)
    assert np.allclose(c.acceleration(), 0.0, atol=1e-3)
    assert not c.done


def test_dropped_it_feels_the_fall() -> None:
    c = standing()
    c.px4.place(pose(np.eye(3), [0.0, 0.0, 5.0]))
    c.advance(0.1)
    assert c.acceleration()[2] == pytest.approx(-9.8, abs=0.5)


def test_time_passes_in_slices_with_a_turn_for_the_companion_after_each() -> None:
    c = standing()
    turns: list[float] = []
    c._between = turns.append
    c.advance(1.0 / 15.0)
    assert len(turns) == 9
    assert max(np.diff(turns)) <= SLICE_S + 1e-9
    c.advance(1.0 - 1.0 / 15.0)
    assert c.px4.elapsed_s == pytest.approx(1.0, abs=0.004)


def test_an_armed_aircraft_is_not_carried_about() -> None:
    c = standing()
    c.px4.vehicle.commander.armed = True
    with pytest.raises(RuntimeError, match="armed"):
        c.px4.place(np.eye(4))
