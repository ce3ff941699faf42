"""What o'clock it is on the router's machine: every service brings its clock to that one, wherever it runs."""

from __future__ import annotations

from typing import ClassVar

from schemas.envelope import Message, Name, StampNs


class ClockRequest(Message):
    """Ask the router for the time; the reply is a ClockReply."""

    SCHEMA: ClassVar[str] = "treedock.clock_request"

    sender: Name


class ClockReply(Message):
    """The router's clock when it answered."""

    SCHEMA: ClassVar[str] = "treedock.clock_reply"

    stamp_ns: StampNs
