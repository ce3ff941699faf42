"""The wire: real sockets on loopback, TIMESYNC answered at once, rubbish survived, bad addresses told in one line."""

from __future__ import annotations

import socket
import time
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mav

from services.common.errors import InputError
from services.navigator.autopilot.link import Codec, MavlinkLink
from services.navigator.autopilot.wire import open_wire


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def _until(condition: Any, limit_s: float = 5.0) -> None:
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.005)


def test_udp_both_ways_with_timesync_answered_by_the_thread() -> None:
    port = _free_port()
    link = MavlinkLink(open_wire(f"udpin:127.0.0.1:{port}"), Codec(191, 1, lambda: 777))
    peer = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.settimeout(5.0)
        s.sendto(b"rubbish" + mav.MAVLink_timesync_message(0, 42).pack(peer), ("127.0.0.1", port))
        answer = peer.parse_buffer(s.recv(2048))[0]
        assert (answer.get_type(), answer.tc1, answer.ts1) == ("TIMESYNC", 777, 42)
        assert (answer.get_srcSystem(), answer.get_srcComponent()) == (1, 191)
        link.identify(9)
        link.send(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        beat = peer.parse_buffer(s.recv(2048))[0]
        assert (beat.get_type(), beat.get_srcSystem()) == ("HEARTBEAT", 9)
        s.sendto(mav.MAVLink_heartbeat_message(2, 12, 0, 6 << 16, 4, 3).pack(peer), ("127.0.0.1", port))
        got: list[Any] = []

        def heard() -> bool:
            got.extend(link.poll())
            return bool(got)

        _until(heard)
        assert got[0][0].get_type() == "HEARTBEAT"
        assert got[0][1] == 777
    link.close()
    assert link.codec.bad_bytes > 0


def test_speaking_first_to_a_dead_port_is_no_error() -> None:
    link = MavlinkLink(open_wire(f"udpout:127.0.0.1:{_free_port()}"), Codec(191, 1, lambda: 0))
    for _ in range(3):
        link.send(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        time.sleep(0.01)
        assert list(link.poll()) == []
    link.close()


@pytest.mark.parametrize(
    "connection",
    ["udp:1.2.3.4:5", "udpin:127.0.0.1", "tcp:127.0.0.1:x", "udpin:127.0.0.1:99999", "tcp:127.0.0.1:1", "nonsense"],
)
def test_bad_addresses_are_told_in_one_line(connection: str) -> None:
    with pytest.raises(InputError) as error:
        open_wire(connection)
    assert connection in str(error.value)
    assert "\n" not in str(error.value)


def test_a_taken_port_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match="in use"):
            open_wire(f"udpin:127.0.0.1:{s.getsockname()[1]}")
