"""Transports of the MAVLink endpoint: datagrams in memory for tests and lockstep, UDP for everybody else."""

from __future__ import annotations

import socket
from collections import deque
from typing import Protocol

from services.common.errors import InputError
from services.simulator.px4.config import LinkConfig


class Link(Protocol):
    """Datagrams both ways; neither call blocks."""

    def send(self, data: bytes) -> None:
        """Send one datagram; a missing peer is no error."""
        ...

    def receive(self) -> bytes | None:
        """Return the next datagram, or None."""
        ...

    def close(self) -> None:
        """Release what the link holds."""
        ...


class LoopbackLink:
    """One end of a pair in memory; ``pair()`` makes both. Nothing is lost, nothing is late."""

    def __init__(self, outgoing: deque[bytes], incoming: deque[bytes]) -> None:
        self._outgoing, self._incoming = outgoing, incoming

    @classmethod
    def pair(cls, depth: int = 4096) -> tuple[LoopbackLink, LoopbackLink]:
        """Return two joined ends; at ``depth`` undelivered datagrams the oldest is lost."""
        a: deque[bytes] = deque(maxlen=depth)
        b: deque[bytes] = deque(maxlen=depth)
        return cls(a, b), cls(b, a)

    def send(self, data: bytes) -> None:
        """Send one datagram to the other end."""
        self._outgoing.append(data)

    def receive(self) -> bytes | None:
        """Return the next datagram, or None."""
        return self._incoming.popleft() if self._incoming else None

    def close(self) -> None:
        """Nothing to release."""


class UdpLink:
    """A bound UDP socket that talks to one remote, as PX4's MAVLink instances do.

    The remote is the configured one until a datagram comes from elsewhere: then the sender is answered. A port that
    is taken raises :class:`InputError`.
    """

    def __init__(self, config: LinkConfig) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((config.host, config.local_port))
        except OSError as error:
            self._socket.close()
            msg = (
                f"simulated autopilot: cannot bind udp {config.host}:{config.local_port} ({error.strerror}); "
                "another simulator runs, or choose another local_port"
            )
            raise InputError(msg) from error
        self._socket.settimeout(0.0)
        self._remote: tuple[str, int] | None = (config.host, config.remote_port) if config.remote_port else None

    @property
    def address(self) -> tuple[str, int]:
        """The bound host and port."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def send(self, data: bytes) -> None:
        """Send to the remote; lost when nobody listens or the buffer is full."""
        if self._remote is None:
            return
        try:
            self._socket.sendto(data, self._remote)
        except (BlockingIOError, ConnectionError, OSError):
            return

    def receive(self) -> bytes | None:
        """Return the next datagram, or None."""
        try:
            data, remote = self._socket.recvfrom(65536)
        except (BlockingIOError, ConnectionError):
            return None
        self._remote = remote
        return data

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
