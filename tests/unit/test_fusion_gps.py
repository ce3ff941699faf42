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
from services.fusion.values import Fused, GpsReading
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


@dataclass(frozen=True)
class Dark:
    """A flight whose receiver jumps, and whose camera is lost from ``dark_s`` on."""

    config: FusionConfig
    jump_s: float
    dark_s: float
    until_s: float
    gps_sigma_m: float

    def flown(self, *, gps: bool) -> tuple[list[Fused | None], Fuser]:
        """Return what is told of each frame, with or without the receiver."""
        fuser, rng = Fuser(self.config.model_copy(update={"gps": gps}), T_BODY_CAMERA), np.random.default_rng(7)
        told: list[Fused | None] = []
        for k in range(-25, round(self.until_s / 0.008)):
            t_s = k * 0.008
            fuser.imu(reading(t_s, 0.008, rng, bias=0.05))
            if k % 25 == 0:
                fuser.fix(GpsReading(stamp_ns(t_s), true_body(t_s)[:3, 3] + jump(self.jump_s)(t_s), self.gps_sigma_m))
            if t_s >= (at_s := len(told) * FRAME_S):
                place = located(at_s, rng)
                told.append(fuser.camera(stamp_ns(at_s), None if at_s > self.dark_s else place))
        return told, fuser


LONG_ALONE = CONFIG.model_copy(update={"imu_alone_s": 3.0, "sigma_m": 5.0, "gps_noise": QUICK})


@pytest.mark.parametrize(
    ("flight", "carried", "apart_m"),
    [
        pytest.param(Dark(LONG_ALONE, 6.4, 6.0, 8.48, 0.3), 26, 0.3, id="told in the dark, while the IMU carries for 3 s"),
        pytest.param(Dark(CONFIG, 4.0, 7.2, 8.0, 1.3), 1, 0.0, id="told in the light, and the IMU's second after it"),
    ],
)  # fmt: skip
def test_a_receiver_that_jumps_by_ten_metres_does_not_carry_the_pose_away(
    flight: Dark, carried: int, apart_m: float
) -> None:
    """While a camera is located, and in the second after it, what is told is the same to the bit."""
    (without, _), (lied_to, fuser) = flight.flown(gps=False), flight.flown(gps=True)
    assert sum(f is not None and f.carrier == "imu" for f in without) >= carried
    for a, b in zip(without, lied_to, strict=True):
        assert (a is None) == (b is None)
        if a is not None and b is not None:
            most_m = apart_m if a.carrier == "imu" else 0.0
            assert float(np.linalg.norm((a.T_map_camera - b.T_map_camera)[:3, 3])) <= most_m
            assert most_m > 0.0 or np.array_equal(a.T_map_camera, b.T_map_camera)
    if apart_m:
        assert fuser.gps is not None
        assert fuser.gps.geo.state is not None
        assert fuser.gps.refused >= 2
