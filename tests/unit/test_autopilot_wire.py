"""The datagram wire: who is heard, and to whom the setpoints go."""

from __future__ import annotations

import os
import pty
import socket
from collections.abc import Iterator

import pytest
from pymavlink.dialects.v20 import common as mav

from services.common.errors import InputError
from services.navigator.autopilot.wire import PEER_SILENT_S, UdpWire, open_wire


class Time:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def wire(time: Time) -> Iterator[UdpWire]:
    wire = UdpWire("127.0.0.1", 0, listen=True, monotonic_s=time)
    yield wire
    wire.close()


def speaker(wire: UdpWire) -> socket.socket:
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.connect(wire._socket.getsockname())
    out.settimeout(0.05)
    return out


def heartbeat() -> bytes:
    return bytes(mav.MAVLink(None, srcSystem=1).heartbeat_encode(2, 12, 0, 0, 4).pack(mav.MAVLink(None)))


def hears(out: socket.socket) -> bool:
    try:
        return bool(out.recv(100))
    except TimeoutError:
        return False


def test_a_stray_datagram_draws_nothing_to_its_sender_and_is_not_heard(wire: UdpWire, time: Time) -> None:
    with speaker(wire) as autopilot, speaker(wire) as stranger:
        autopilot.send(heartbeat())
        assert wire.read() == heartbeat()
        for data in (b"\xfd\xff\x00", os.urandom(200), heartbeat()):
            time.now_s += 0.1
            stranger.send(data)
            assert wire.read() == b""
        wire.write(b"setpoint")
        assert hears(autopilot)
        assert not hears(stranger)
        assert wire.strays == 3


def test_noise_is_never_taken_for_an_autopilot(wire: UdpWire) -> None:
    with speaker(wire) as stranger:
        stranger.send(b"\xfd\x09\x00\x00" + os.urandom(40))
        assert wire.read() == b""
        wire.write(b"setpoint")
        assert not hears(stranger)


def test_an_autopilot_that_fell_silent_may_come_back_from_elsewhere(wire: UdpWire, time: Time) -> None:
    with speaker(wire) as before, speaker(wire) as after:
        before.send(heartbeat())
        wire.read()
        time.now_s += PEER_SILENT_S
        after.send(heartbeat())
        assert wire.read() == heartbeat()
        wire.write(b"setpoint")
        assert hears(after)


def test_a_serial_line_carries_bytes_both_ways_and_tells_when_it_is_pulled() -> None:
    pytest.importorskip("serial")
    autopilot, ours = pty.openpty()
    wire = open_wire(f"serial:{os.ttyname(ours)}:921600")
    try:
        with pytest.raises(InputError, match="exclusive"):
            open_wire(f"serial:{os.ttyname(ours)}:921600")
        wire.write(b"there")
        assert os.read(autopilot, 16) == b"there"
        os.write(autopilot, b"back")
        got = wire.read()
        while len(got) < 4:
            got += wire.read()
        assert got == b"back"
        assert wire.read() == b""
        os.close(autopilot)
        with pytest.raises(OSError, match=r"\S"):
            wire.read()
    finally:
        wire.close()
        os.close(ours)
    with pytest.raises(InputError, match=r"serial:/dev/nowhere:57600.*No such file"):
        open_wire("serial:/dev/nowhere:57600")
