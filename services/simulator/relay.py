"""Between a PX4 in simulation and the autopilot bridge: passes raw MAVLink on, keeps the true pose for the simulator.

A process of its own (``python -m services.simulator.relay``), because TIMESYNC must be answered within 10 ms and the
simulator renders for longer than that. It parses no more of MAVLink than the frames' heads.
"""

from __future__ import annotations

import argparse
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

HIL_STATE_QUATERNION, HEARTBEAT, COMMAND_ACK = 115, 0, 77
_V1, _V2 = 0xFE, 0xFD
_SIGNED = 0x01
_SIGNATURE_BYTES = 13
OUR_COMPONENT = 192
"""MAV_COMP_ID_ONBOARD_COMPUTER2: who asks for the truth; the bridge is 191."""
_ASK_AGAIN_S = 2.0
_SILENT_S = 1.0
_LARGEST = 65535
_STAMP = struct.Struct("<q")

Address = tuple[str, int]


def split(data: bytes) -> Iterator[tuple[int | None, bytes]]:
    """Return the MAVLink frames of a datagram as ``(message id, bytes)``; what is none of them as ``(None, bytes)``."""
    at = 0
    while at < len(data):
        head = data[at : at + 10]
        if head[0] == _V2 and len(head) == 10:
            size = 12 + head[1] + (_SIGNATURE_BYTES if head[2] & _SIGNED else 0)
            ident: int | None = int.from_bytes(head[7:10], "little")
        elif head[0] == _V1 and len(head) >= 6:
            size, ident = 8 + head[1], head[5]
        else:
            size, ident = len(data), None
        yield ident, data[at : at + size]
        at += size


@dataclass
class Endpoint:
    """A UDP socket with one peer: fixed, or whoever spoke last."""

    bound: socket.socket
    peer: Address | None = None

    @classmethod
    def opened(cls, connection: str) -> Endpoint:
        """Open ``udpin:HOST:PORT`` (listens) or ``udpout:HOST:PORT`` (speaks to).

        Raises:
            OSError: the address is in use or not ours.
            ValueError: another form.
        """
        kind, _, rest = connection.partition(":")
        host, _, port = rest.rpartition(":")
        if kind not in {"udpin", "udpout"} or not host:
            raise ValueError(f"{connection!r}: expected udpin:HOST:PORT or udpout:HOST:PORT")
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.settimeout(0.0)
        if kind == "udpin":
            made.bind((host, int(port)))
            return cls(made)
        made.bind(("0.0.0.0", 0))  # the answers' port; the peer is fixed
        return cls(made, (host, int(port)))

    def receive(self) -> bytes | None:
        """Return the next datagram, or None."""
        try:
            data, self.peer = self.bound.recvfrom(_LARGEST)
        except (BlockingIOError, ConnectionError):
            return None
        return data

    def send(self, data: bytes) -> None:
        """Send to the peer; nobody there is no error."""
        if self.peer is None:
            return
        try:
            self.bound.sendto(data, self.peer)
        except (BlockingIOError, ConnectionError):
            return


@dataclass
class Relay:
    """Passes datagrams between ``px4`` and ``bridge``; the truth goes to ``truth``, stamped (monotonic ns, 8 bytes)."""

    px4: Endpoint
    bridge: Endpoint
    truth: Endpoint
    rate_hz: float
    now_s: Callable[[], float] = time.monotonic
    passed: dict[str, int] = field(default_factory=lambda: {"to_bridge": 0, "to_px4": 0, "truth": 0})
    _system: int | None = None
    _asked_s: float = -1e9
    _true_s: float = -1e9

    def run(self, alive: Callable[[], bool]) -> None:
        """Work until ``alive()`` says no."""
        selector = selectors.DefaultSelector()
        for end in (self.px4, self.bridge):
            selector.register(end.bound, selectors.EVENT_READ)
        while alive():
            selector.select(0.2)
            self.work()

    def work(self) -> None:
        """Pass on all that is there."""
        while (data := self.px4.receive()) is not None:
            self._from_px4(data)
        while (data := self.bridge.receive()) is not None:
            self.passed["to_px4"] += 1
            self.px4.send(data)
        self._ask()

    def _from_px4(self, data: bytes) -> None:
        on: list[bytes] = []
        for ident, frame in split(data):
            if ident == HIL_STATE_QUATERNION:
                self._true_s = self.now_s()
                self.passed["truth"] += 1
                self.truth.send(_STAMP.pack(round(self._true_s * 1e9)) + frame)
                continue
            if ident == HEARTBEAT:
                self._note_system(frame)
            if not (ident == COMMAND_ACK and self._is_ours(frame)):
                on.append(frame)
        if on:
            self.passed["to_bridge"] += 1
            self.bridge.send(b"".join(on))

    def _note_system(self, frame: bytes) -> None:
        """Learn the autopilot's system id from its heartbeat (component 1)."""
        system, component = (frame[5], frame[6]) if frame[0] == _V2 else (frame[3], frame[4])
        if component == 1:
            self._system = system

    @staticmethod
    def _is_ours(frame: bytes) -> bool:
        """Whether an acknowledgement names our component as its target (the last extension field)."""
        return frame[0] == _V2 and frame[1] == 10 and frame[19] == OUR_COMPONENT

    def _ask(self) -> None:
        """Ask for the truth until it comes."""
        now_s = self.now_s()
        if self._system is None or now_s - self._true_s < _SILENT_S or now_s - self._asked_s < _ASK_AGAIN_S:
            return
        self._asked_s = now_s
        self.px4.send(request(self._system, self.rate_hz))


def request(system: int, rate_hz: float) -> bytes:
    """Return SET_MESSAGE_INTERVAL for the true pose, packed."""
    from pymavlink.dialects.v20 import common as m

    sender = m.MAVLink(None, srcSystem=system, srcComponent=OUR_COMPONENT)
    wanted = m.MAVLink_command_long_message(
        system, 1, m.MAV_CMD_SET_MESSAGE_INTERVAL, 0, HIL_STATE_QUATERNION, 1e6 / rate_hz, 0, 0, 0, 0, 0
    )
    return bytes(wanted.pack(sender))


def main() -> None:
    """Run a relay until the simulator that started it ends."""
    from services.common.process import die_with_parent

    parser = argparse.ArgumentParser(description="relay between a PX4 in simulation and the autopilot bridge")
    for name in ("px4", "bridge", "truth"):
        parser.add_argument(name)
    parser.add_argument("rate_hz", type=float)
    parser.add_argument("parent", type=int)
    arguments = parser.parse_args()
    die_with_parent()
    ends = (Endpoint.opened(arguments.px4), Endpoint.opened(arguments.bridge), Endpoint.opened(arguments.truth))
    Relay(*ends, arguments.rate_hz).run(lambda: os.getppid() == arguments.parent)


if __name__ == "__main__":
    main()
