"""A companion's MAVLink link in the same process as the simulated autopilot: no socket, no thread, no wall clock."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from services.simulator.px4.links import LoopbackLink
from services.simulator.px4.simulated import SimulatedPx4


class Codec(Protocol):
    """What turns messages into bytes and back (the bridge's own, so that TIMESYNC is answered as on a real wire)."""

    def pack(self, message: Any) -> bytes:  # noqa: ANN401  # generated message classes share no useful type
        """Return the frame of a message."""
        ...

    def take(self, data: bytes, answer: Callable[[bytes], None]) -> list[tuple[Any, int]]:
        """Return the messages in ``data`` with their arrival times; ``answer`` sends what cannot wait."""
        ...

    def identify(self, system: int) -> None:
        """Speak as a component of this system."""
        ...


class InProcessLink:
    """The bridge's link (``poll``, ``send``, ``identify``) to a simulated autopilot stepped by somebody else."""

    def __init__(self, px4: SimulatedPx4, codec: Codec) -> None:
        self._codec = codec
        self._ours, theirs = LoopbackLink.pair()
        px4.attach(theirs)

    def poll(self) -> list[tuple[Any, int]]:
        """Return the messages that came since the last call with their times of arrival, nanoseconds."""
        out: list[tuple[Any, int]] = []
        while (data := self._ours.receive()) is not None:
            out.extend(self._codec.take(data, self._ours.send))
        return out

    def send(self, message: Any) -> None:  # noqa: ANN401
        """Send a message."""
        self._ours.send(self._codec.pack(message))

    def identify(self, system: int) -> None:
        """Speak as a component of this system from now on."""
        self._codec.identify(system)
