"""The relay between a PX4 in simulation and the bridge, and the pose that it lets the simulator have."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as m

from services.common.geometry import Matrix, camera_yaw, pose, rotation_z
from services.common.mount import Mount
from services.simulator.external import TruthTrack
from services.simulator.px4.config import Px4Config
from services.simulator.px4.simulated import SimulatedPx4
from services.simulator.px4.telemetry import hil_state_quaternion
from services.simulator.relay import OUR_COMPONENT, Endpoint, Relay, split


class Ends:
    """A relay with a PX4, a bridge and a simulator on its three sockets."""

    def __init__(self) -> None:
        self.bridge = Endpoint.opened("udpin:127.0.0.1:0")
        self.simulator = Endpoint.opened("udpin:127.0.0.1:0")
        px4_side = Endpoint.opened("udpin:127.0.0.1:0")
        self.now_s = 100.0
        self.relay = Relay(
            px4_side, Endpoint.opened(self._to(self.bridge)), Endpoint.opened(self._to(self.simulator)), 50.0,
            lambda: self.now_s,
        )  # fmt: skip
        self.px4 = Endpoint.opened(self._to(px4_side))
        self.mav = m.MAVLink(None, srcSystem=7, srcComponent=1)

    @staticmethod
    def _to(end: Endpoint) -> str:
        return f"udpout:127.0.0.1:{end.bound.getsockname()[1]}"

    def px4_says(self, *messages: m.MAVLink_message) -> None:
        self.px4.send(b"".join(message.pack(self.mav) for message in messages))
        time.sleep(0.01)
        self.relay.work()
        time.sleep(0.01)

    def close(self) -> None:
        ends = (self.bridge, self.simulator, self.px4, self.relay.px4, self.relay.bridge, self.relay.truth)
        for end in ends:
            end.bound.close()


@pytest.fixture
def ends() -> Iterator[Ends]:
    made = Ends()
    yield made
    made.close()


def heartbeat() -> m.MAVLink_heartbeat_message:
    return m.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)


def truth() -> m.MAVLink_hil_state_quaternion_message:
    px4 = SimulatedPx4(lambda _x, _y: 0.0, pose(np.eye(3), (0.0, 0.0, 0.1)), Px4Config(links=()), 1)
    return hil_state_quaternion(px4.vehicle)


def idents(data: bytes | None) -> list[int | None]:
    return [ident for ident, _ in split(data or b"")]


def test_the_truth_goes_to_the_simulator_and_to_nobody_else(ends: Ends) -> None:
    ends.px4_says(heartbeat(), truth(), m.MAVLink_sys_status_message(*[0] * 13))
    assert idents(ends.bridge.receive()) == [m.MAVLINK_MSG_ID_HEARTBEAT, m.MAVLINK_MSG_ID_SYS_STATUS]
    data = ends.simulator.receive()
    assert data is not None
    assert int.from_bytes(data[:8], "little") == 100_000_000_000
    assert idents(data[8:]) == [m.MAVLINK_MSG_ID_HIL_STATE_QUATERNION]
    ends.px4_says(truth())
    assert ends.bridge.receive() is None


def test_it_asks_for_the_truth_until_it_comes(ends: Ends) -> None:
    ends.px4_says(heartbeat())
    asked = ends.px4.receive()
    assert asked is not None
    message = m.MAVLink(None).parse_buffer(asked)[0]
    assert (message.command, message.param1, message.param2) == (m.MAV_CMD_SET_MESSAGE_INTERVAL, 115.0, 20_000.0)
    assert (message.get_srcSystem(), message.target_system) == (7, 7)
    ends.px4_says(heartbeat())
    assert ends.px4.receive() is None  # not at every turn
    ends.now_s += 2.5
    ends.px4_says(truth())
    assert ends.px4.receive() is None
    ends.now_s += 2.5
    ends.px4_says(heartbeat())
    assert ends.px4.receive() is not None


def test_acknowledgements_of_its_own_orders_stay_with_it(ends: Ends) -> None:
    ours = m.MAVLink_command_ack_message(511, 0, 0, 0, 7, OUR_COMPONENT)
    theirs = m.MAVLink_command_ack_message(511, 0, 0, 0, 7, 191)
    ends.px4_says(ours, theirs)
    frames = list(split(ends.bridge.receive() or b""))
    assert len(frames) == 1
    assert frames[0][1][19] == 191


def test_the_bridge_is_passed_on_as_it_is_and_noise_does_no_harm(ends: Ends) -> None:
    ends.px4_says(heartbeat())
    ends.px4.receive()
    ends.bridge.receive()
    ends.bridge.send(b"\x01 anything \xff")
    time.sleep(0.01)
    ends.relay.work()
    time.sleep(0.01)
    assert ends.px4.receive() == b"\x01 anything \xff"
    ends.px4.send(b"\xfd\x05")
    ends.px4.send(b"noise")
    ends.px4.send(b"\xfe" + bytes(300))
    time.sleep(0.01)
    ends.relay.work()


def test_other_addresses_are_refused() -> None:
    for wrong in ("tcp:127.0.0.1:5", "udpin:5", "udpin::"):
        with pytest.raises(ValueError, match="expected"):
            Endpoint.opened(wrong)


def camera_of(T_world_body: Matrix) -> Matrix:
    return T_world_body @ Mount.level((0.0, 0.0, 0.0)).T_body_camera


def test_the_told_pose_begins_at_the_scenes_start_whatever_px4s_own_is() -> None:
    start = pose(rotation_z(0.7), (0.0, 0.0, 0.35))
    px4 = SimulatedPx4(lambda _x, _y: 0.0, pose(rotation_z(-2.0), (3.0, -1.0, 0.1)), Px4Config(links=()), 1)
    track = TruthTrack(start)
    T = track.take(hil_state_quaternion(px4.vehicle), 5.0)
    assert T is not None
    assert np.allclose(T[:3, 3], start[:3, 3], atol=1e-6)
    assert camera_yaw(camera_of(T)) == pytest.approx(0.7, abs=1e-3)


def test_a_flown_path_is_followed_to_a_centimetre() -> None:
    """The position comes in steps of 1.1 cm; smoothed with the told velocity it is better than that."""
    start = pose(rotation_z(0.7), (0.0, 0.0, 0.1))
    px4 = SimulatedPx4(lambda _x, _y: 0.0, start, Px4Config(links=()), 1)
    track, off, pulled = TruthTrack(start), [], []
    late_s = np.random.default_rng(1).uniform(0.0, 0.004, 500)
    for i in range(500):
        t = 0.02 * i
        body = px4.vehicle.body.state
        body[:3] = (np.sin(t), 0.5 * np.sin(0.7 * t), -0.1 - 0.3 * (1.0 - np.cos(t)))
        body[3:6] = (np.cos(t), 0.35 * np.cos(0.7 * t), -0.3 * np.sin(t))
        px4.vehicle.ticks = 5 * i
        T = track.take(hil_state_quaternion(px4.vehicle), 1000.0 + t + float(late_s[i]))
        assert T is not None
        off.append(np.linalg.norm(T[:3, 3] - px4.true_pose()[:3, 3]))
        before = t - 0.125  # the middle of the window
        true = np.array([-np.sin(before), 0.245 * np.sin(0.7 * before), 0.3 * np.cos(before)])
        pulled.append(np.linalg.norm(track.acceleration_m_s2 - true))
    assert np.percentile(off[50:], 95) < 0.01
    assert np.percentile(pulled[50:], 95) < 0.1


def test_a_px4_that_boots_has_no_pose_yet() -> None:
    """It tells zeros for what it does not know; the start is the first whole message."""
    start = pose(rotation_z(0.7), (0.0, 0.0, 0.1))
    px4 = SimulatedPx4(lambda _x, _y: 0.0, start, Px4Config(links=()), 1)
    whole = hil_state_quaternion(px4.vehicle)
    track = TruthTrack(start)
    for left_out in ("attitude_quaternion", "place"):
        told = hil_state_quaternion(px4.vehicle)
        if left_out == "place":
            told.lat = told.lon = told.alt = 0
        else:
            told.attitude_quaternion = [0.0] * 4
        assert track.take(told, 1.0) is None
    T = track.take(whole, 2.0)
    assert T is not None
    assert np.allclose(T[:3, 3], start[:3, 3])
