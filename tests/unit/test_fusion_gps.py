"""GPS in fusion: the map's place on the earth, and receivers that jump, are dragged away, fall silent or come back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from services.common.geometry import Matrix, pose, rotation_z
from services.fusion.config import FusionConfig, GpsConfig
from services.fusion.fuser import Fuser
from services.fusion.gps import GpsDesk
from services.fusion.smoother import State
from services.fusion.values import GpsReading
from tests.unit.fusion_motion import FRAME_S, T_BODY_CAMERA, located, reading, stamp_ns, true_body

CONFIG = FusionConfig(gps=True)
QUICK = GpsConfig(begin_m=1.5, slow_m=0.3, white_m=0.1, delay_s=0.0)
YAW_RAD, OFFSET_M = 1.1, np.array([3.0, -2.0, 0.5])
GPS_S = 0.2
Lie = Callable[[float], Matrix]


def nothing(_t_s: float) -> Matrix:
    return np.zeros(3)


def jump(at_s: float) -> Lie:
    return lambda t: np.array([8.0, 6.0, 0.0]) if t >= at_s else np.zeros(3)


def drag(from_s: float, speed_m_s: float) -> Lie:
    return lambda t: np.array([speed_m_s, 0.0, 0.0]) * max(0.0, t - from_s)


def on_way(t_s: float) -> Matrix:
    """Return where the aircraft is in W: a circle of 9 m at half a metre a second."""
    return np.array([9.0 * np.sin(t_s / 18.0), 9.0 * (1.0 - np.cos(t_s / 18.0)), 0.2 * np.sin(t_s / 5.0)])


@dataclass
class Walk:
    """A walk with a receiver: its slow error is the model's own."""

    seed: int
    lie: Lie = nothing
    desk: GpsDesk = field(default_factory=lambda: GpsDesk(CONFIG))
    error_m: list[float] = field(default_factory=list)
    trusted: list[bool] = field(default_factory=list)

    def go(self, seconds: float, silent: tuple[float, float] = (-1.0, -1.0)) -> Walk:
        """Walk for so long."""
        rng = np.random.default_rng(self.seed)
        slow, keep = 1.2 * rng.standard_normal(3), np.exp(-GPS_S / 80.0)
        states: list[State] = []
        for k in range(round(seconds / GPS_S)):
            t_s = k * GPS_S
            slow = keep * slow + np.sqrt(1.0 - keep**2) * 1.2 * rng.standard_normal(3)
            true = rotation_z(YAW_RAD) @ on_way(t_s) + OFFSET_M
            if not silent[0] <= t_s < silent[1]:
                fix = true + slow + 0.4 * rng.standard_normal(3) + self.lie(t_s)
                self.desk.take(GpsReading(stamp_ns(t_s), fix, 1.3))
            states = [
                *states[-5:], State(k, stamp_ns(t_s + 0.05), pose(np.eye(3), on_way(t_s + 0.05)), np.zeros(3))
            ]  # fmt: skip
            self.desk.due(states, seen=True)
            if self.desk.geo.state is not None:
                self.error_m.append(float(np.linalg.norm((self.desk.geo.on_earth(on_way(t_s)) - true)[:2])))
            self.trusted.append(self.desk.trust(stamp_ns(t_s)) == "trusted")
        return self


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_the_map_finds_its_place_on_the_earth(seed: int) -> None:
    walk = Walk(seed).go(120.0)
    assert walk.trusted[-1]
    assert walk.desk.refused <= 2
    state = walk.desk.geo.state
    assert state is not None
    assert abs(float(state.x[0]) - YAW_RAD) < 3.5 * float(np.sqrt(state.P[0, 0]))
    assert max(walk.error_m[100:]) < 4.5, "the receiver's own slow error, no more"


def test_an_aircraft_that_stands_has_no_heading_on_the_earth() -> None:
    desk = GpsDesk(CONFIG)
    rng = np.random.default_rng(1)
    for k in range(200):
        desk.take(GpsReading(stamp_ns(0.2 * k), 0.5 * rng.standard_normal(3), 1.3))
        desk.due(
            [State(i, stamp_ns(0.2 * k + d), np.eye(4), np.zeros(3)) for i, d in enumerate((-0.05, 0.05))], seen=True
        )
    assert desk.geo.state is None
    assert desk.trust(stamp_ns(40.0)) == "waiting"
    assert desk.trust(stamp_ns(60.0)) == "silent"


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
@pytest.mark.parametrize("lie", [jump(60.0), drag(60.0, 0.3), drag(60.0, 0.15)], ids=["jump", "drag", "slow drag"])
def test_a_receiver_that_lies_is_caught_and_what_it_did_is_taken_back(seed: int, lie: Lie) -> None:
    honest, lied = Walk(seed).go(120.0), Walk(seed, lie).go(120.0)
    caught = next(k for k, trusted in enumerate(lied.trusted) if not trusted and k * GPS_S > 60.0) * GPS_S
    assert caught < 100.0
    assert not lied.trusted[-1]
    worst = max(lied.error_m[-round(20.0 / GPS_S) :])
    assert worst < max(honest.error_m[100:]) + 1.5
    assert lied.desk.jury.why


def test_an_honest_receiver_is_believed_again_and_its_offset_is_its_own() -> None:
    walk = Walk(3, lambda t: np.array([8.0, 6.0, 0.0]) if 60.0 <= t < 70.0 else np.zeros(3)).go(190.0)
    assert not walk.trusted[round(75.0 / GPS_S)]
    assert walk.trusted[-1]
    assert max(walk.error_m[-50:]) < 4.5


def test_silence_is_told_and_what_comes_after_it_is_used() -> None:
    walk = Walk(2).go(90.0, silent=(50.0, 60.0))
    assert not walk.trusted[round(58.0 / GPS_S)]
    assert walk.trusted[-1]


def test_a_lie_told_in_the_dark_does_not_carry_the_pose_away() -> None:
    """The receiver jumps by 10 m while no camera sees; the IMU carries the pose for three seconds."""
    carried = []
    for gps in (False, True):
        config = CONFIG.model_copy(update={"gps": gps, "imu_alone_s": 3.0, "sigma_m": 5.0, "gps_noise": QUICK})
        fuser, rng, frames, told = Fuser(config, T_BODY_CAMERA), np.random.default_rng(7), 0, []
        for k in range(-25, 1060):
            t_s = k * 0.008
            fuser.imu(reading(t_s, 0.008, rng, bias=0.05))
            if k % 25 == 0:
                fuser.fix(GpsReading(stamp_ns(t_s), true_body(t_s)[:3, 3] + jump(6.4)(t_s), 0.3))
            if t_s >= frames * FRAME_S:
                at_s, frames = frames * FRAME_S, frames + 1
                place = located(at_s, rng)
                fused = fuser.camera(stamp_ns(at_s), None if at_s > 6.0 else place)
                told += [fused] if fused is not None and fused.carrier == "imu" else []
        carried.append(told)
        assert fuser.gps is None or (fuser.gps.geo.state is not None and fuser.gps.refused >= 2)
    assert len(carried[0]) == len(carried[1]) > 25
    apart = [np.linalg.norm((a.T_map_camera - b.T_map_camera)[:3, 3]) for a, b in zip(*carried, strict=True)]
    assert max(apart) < 0.3


def test_no_gps_moves_a_pose_in_the_map() -> None:
    """What is told while a camera is located, and the IMU's second after it, is the same with a receiver that lies."""
    flights = []
    for config in (FusionConfig(), CONFIG):
        fuser, rng, frames, told = Fuser(config, T_BODY_CAMERA), np.random.default_rng(7), 0, []
        for k in range(-25, 1000):
            t_s = k * 0.008
            fuser.imu(reading(t_s, 0.008, rng, bias=0.05))
            if k % 25 == 0:
                fuser.fix(GpsReading(stamp_ns(t_s), true_body(t_s)[:3, 3] + jump(4.0)(t_s), 1.3))
            if t_s >= frames * FRAME_S:
                at_s, frames = frames * FRAME_S, frames + 1
                place = located(at_s, rng)
                told.append(fuser.camera(stamp_ns(at_s), None if at_s > 7.2 else place))
        flights.append(told)
    assert any(f is not None and f.carrier == "imu" for f in flights[0])
    for a, b in zip(*flights, strict=True):
        assert (a is None) == (b is None)
        assert a is None or b is None or np.array_equal(a.T_map_camera, b.T_map_camera)
