"""Controllers, land detector, commander and clock synchronisation on their own."""

from __future__ import annotations

import math
import socket

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.common.errors import InputError
from services.common.geometry import Matrix
from services.simulator.px4 import control, estimator, quadrotor
from services.simulator.px4.config import LinkConfig
from services.simulator.px4.control import AttitudeSetpoint, PositionController, Setpoint, attitude_rates
from services.simulator.px4.frames import wxyz_from_yaw
from services.simulator.px4.kernels import quaternion_times_exp, rotate
from services.simulator.px4.links import UdpLink
from services.simulator.px4.modes import BY_MODE, NavState, SetpointStream
from services.simulator.px4.params import Parameters
from services.simulator.px4.runner import RealTimeRunner
from services.simulator.px4.timesync import CONVERGENCE_SAMPLES, Timesync
from services.simulator.px4.warm import warm

PARAMS = Parameters()


def controller_output(setpoint: Setpoint, position: Matrix | None = None) -> AttitudeSetpoint:
    c = PositionController(PARAMS)
    return c.update(setpoint, np.zeros(3) if position is None else position, np.zeros(3), 0.0, 0.02)


def test_on_the_spot_thrust_is_gravity_straight_up() -> None:
    out = controller_output(Setpoint(np.zeros(3), yaw_rad=0.3))
    assert np.allclose(out.thrust_axis, [0.0, 0.0, -1.0])
    assert out.thrust_m_s2 == pytest.approx(9.80665)
    assert out.yaw_rad == 0.3


def test_a_place_ahead_tilts_forward_by_the_documented_gains() -> None:
    out = controller_output(Setpoint(np.array([1.0, 0.0, 0.0])))
    wanted = PARAMS["MPC_XY_P"] * PARAMS["MPC_XY_VEL_P_ACC"]
    assert math.tan(math.atan2(float(out.thrust_axis[0]), -float(out.thrust_axis[2]))) == pytest.approx(
        wanted / 9.80665, rel=1e-6
    )


def test_limits_hold_however_far_the_place_is() -> None:
    out = controller_output(Setpoint(np.array([1e4, -1e4, -1e4])))
    tilt = math.degrees(math.acos(-float(out.thrust_axis[2])))
    assert tilt <= PARAMS["MPC_TILTMAX_AIR"] + 1e-6
    assert out.thrust_m_s2 <= 9.80665 / PARAMS["MPC_THR_HOVER"] + 1e-9


@settings(max_examples=60, deadline=None)
@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_attitude_rates_turn_towards_the_setpoint(roll: float, pitch: float, yaw: float, yaw_sp: float) -> None:
    q = wxyz_from_yaw(yaw)
    quaternion_times_exp(q, np.array([roll, pitch, 0.0]), 1.0)
    setpoint = AttitudeSetpoint(np.array([0.0, 0.0, -1.0]), 9.8, yaw_sp, 0.0)
    for _ in range(600):
        quaternion_times_exp(q, attitude_rates(setpoint, q, PARAMS), 0.008)
    assert rotate(q, np.array([0.0, 0.0, 1.0]))[2] > 0.9999
    assert abs(math.remainder(yaw_sp - 2.0 * math.atan2(float(q[3]), float(q[0])), 2.0 * math.pi)) < 0.01


def test_custom_modes_are_px4s() -> None:
    assert NavState.OFFBOARD.custom_mode == 6 << 16
    assert NavState.LAND.custom_mode == 4 << 16 | 6 << 24
    assert NavState.HOLD.custom_mode == 4 << 16 | 3 << 24
    assert NavState.DESCEND.custom_mode == NavState.LAND.custom_mode
    assert BY_MODE[(4, 6)] is NavState.LAND


def test_a_gap_in_the_stream_begins_it_anew() -> None:
    s = SetpointStream()
    for i in range(30):
        s.arrived(0.05 * i)
    assert s.proven(1.45, 1.0)
    s.arrived(2.1)
    assert s.fresh(2.2, 1.0)
    assert not s.proven(2.2, 1.0)


def test_timesync_learns_offset_and_skew_and_starts_anew_after_a_jump() -> None:
    sync = Timesync()
    skew, offset = 1.00002, -4000.0

    def feed(count: int, start: int, jump_s: float = 0.0) -> float:
        now = 0.0
        for i in range(start, start + count):
            now = 0.1 * i
            companion = (now - offset) * skew + jump_s
            sync.update(now + 0.002, now - 0.002, companion)
        return now

    now = feed(CONVERGENCE_SAMPLES + 100, 0)
    assert sync.converged
    assert sync.to_autopilot_s((now - offset) * skew, now) == pytest.approx(now, abs=0.005)
    feed(12, 700, jump_s=3.0)
    assert not sync.converged


def test_timesync_passes_arrival_time_until_it_has_converged() -> None:
    assert Timesync().to_autopilot_s(123.0, 7.0) == 7.0


def test_udp_link_carries_datagrams_and_names_a_taken_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(5.0)
        link = UdpLink(LinkConfig(local_port=0, remote_port=peer.getsockname()[1]))
        link.send(b"there")
        data, sender = peer.recvfrom(100)
        assert (data, sender) == (b"there", link.address)
        assert link.receive() is None
        with pytest.raises(InputError, match=f"{link.address[1]}"):
            UdpLink(LinkConfig(local_port=link.address[1]))
        link.close()


def test_sending_to_nobody_is_no_error() -> None:
    link = UdpLink(LinkConfig(local_port=0, remote_port=9))
    for _ in range(3):
        link.send(b"x")
        assert link.receive() is None
    link.close()


def test_runner_hands_on_the_error_of_its_step() -> None:
    def step(_dt_s: float) -> None:
        raise RuntimeError("boom")

    runner = RealTimeRunner(step, 0.01)
    with pytest.raises(RuntimeError, match="boom"), runner:
        runner._thread.join(5.0)


def test_warm_loads_every_kernel_that_python_calls() -> None:
    warm()  # kernels called by kernels come compiled within them
    entries = {
        control: ("_attitude_rates",),
        estimator: ("fuse", "innovation_variance", "predict", "replay", "yaw_row"),
        quadrotor: ("advance",),
    }
    for module, names in entries.items():
        for name in names:
            assert getattr(module, name).signatures, f"{module.__name__}.{name} would compile in flight"
