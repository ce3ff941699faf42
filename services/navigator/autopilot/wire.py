"""The wires to the autopilot: UDP, TCP or serial. Bytes out and in."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable
from typing import Protocol

from pymavlink.dialects.v20 import common as mav

from services.common.errors import InputError

WAIT_S = 0.2
"""Longest wait of a read."""
PEER_SILENT_S = 1.0
"""As long as the bridge takes to give the link up (autopilot.link_lost_s): then it may come back from elsewhere."""
_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class Wire(Protocol):
    """Bytes out and in; ``read`` waits a short while and may return nothing."""

    def read(self) -> bytes: ...  # noqa: D102
    def write(self, data: bytes) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


def _speaks_mavlink(data: bytes) -> bool:
    """Whether a datagram holds a whole MAVLink message with a right checksum."""
    parser = mav.MAVLink(None)
    parser.robust_parsing = True
    # a message that the dialect does not know has no checksum that could be told right
    return any(not m.get_type().startswith(("BAD_DATA", "UNKNOWN")) for m in parser.parse_buffer(data) or ())


class UdpWire:
    """A datagram socket that speaks to a fixed address, or listens and speaks to whoever speaks MAVLink to it.

    While that one speaks nobody else is heard: a stray datagram must neither draw the setpoints to its sender nor break
    the autopilot's messages apart. Another may take its place once it was silent for ``PEER_SILENT_S``.
    """

    def __init__(
        self, host: str, port: int, *, listen: bool, monotonic_s: Callable[[], float] = time.monotonic
    ) -> None:
        self._monotonic_s = monotonic_s
        self._heard_s = -math.inf
        self.strays = 0
        """Datagrams that came from elsewhere."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(WAIT_S)
        self._peer: tuple[str, int] | None = None if listen else (host, port)
        if listen:
            try:
                self._socket.bind((host, port))
            except (OSError, OverflowError):
                self._socket.close()
                raise

    def read(self) -> bytes:
        """Return the next datagram, empty after a short wait."""
        try:
            data, sender = self._socket.recvfrom(65535)
        except (TimeoutError, ConnectionRefusedError):
            return b""
        now_s = self._monotonic_s()
        if sender != self._peer:
            if now_s - self._heard_s < PEER_SILENT_S or not _speaks_mavlink(data):
                self.strays += 1
                return b""
            self._peer = sender
        self._heard_s = now_s
        return data

    def write(self, data: bytes) -> None:
        """Send a datagram to the peer, if there is one."""
        if self._peer is not None:
            self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpWire:
    """A TCP client; a lost connection raises OSError."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=5.0)
        self._socket.settimeout(WAIT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self) -> bytes:
        """Return what came, empty after a short wait."""
        try:
            data = self._socket.recv(65535)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("the autopilot closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """Send all of it."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialWire:
    """A serial port, through pyserial."""

    def __init__(self, device: str, baud: int) -> None:
        try:
            import serial  # type: ignore[import-untyped, unused-ignore]
        except ImportError as error:
            raise InputError(
                f"serial:{device}: the package pyserial is missing: run deploy/install (or make setup) again"
            ) from error
        # exclusive: a second bridge by mistake would mix its setpoints with ours
        self._port = serial.Serial(device, baud, timeout=WAIT_S, write_timeout=WAIT_S, exclusive=True)

    def read(self) -> bytes:
        """Return what came, empty after a short wait."""
        return bytes(self._port.read(max(1, self._port.in_waiting)))

    def write(self, data: bytes) -> None:
        """Send all of it."""
        self._port.write(data)

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def open_wire(connection: str) -> Wire:
    """Open the wire that ``connection`` names.

    Raises:
        InputError: a form that is not known, an address in use, a device that is not there.
    """
    kind, _, rest = connection.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in ("udpin", "udpout", "tcp", "serial") or not place or not number.isdigit():
        raise InputError(f"autopilot.connection {connection!r}: expected {_FORMS}")
    try:
        if kind == "serial":
            return SerialWire(place, int(number))
        if kind == "tcp":
            return TcpWire(place, int(number))
        return UdpWire(place, int(number), listen=kind == "udpin")
    except (OSError, OverflowError) as error:
        raise InputError(f"autopilot.connection {connection!r}: {error}") from error
