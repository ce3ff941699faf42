"""A service's own account of itself, made by its work loop once a second."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Label, Message, Name, StampNs, Text

Count = Annotated[int, Field(ge=0)]


class Health(Message):
    """Health of one service."""

    SCHEMA: ClassVar[str] = "treedock.health"
    VERSION: ClassVar[int] = 2

    service: Name
    stamp_ns: StampNs
    seq: Counter
    state: Literal["starting", "ready", "degraded", "stopping"]
    pid: Annotated[int, Field(ge=0)]
    uptime_s: Annotated[float, Field(ge=0.0)]
    counters: Annotated[dict[Label, Count], Field(max_length=128)]
    """What was done and what was refused since the start: frames, decode_errors, dropped, ..."""
    rates_hz: Annotated[dict[Label, float], Field(max_length=64)]
    """Measured rate of each topic received and sent, over the last second."""
    work_ms: Annotated[dict[Label, float], Field(max_length=64)]
    """Median duration of each stage over the last second."""
    note: Text = ""
    """What is wrong and what to do about it; empty when all is well."""
    version: Text = ""
    """Of the treedock that runs there (``services.common.version``): both ends must agree on messages and keys."""
