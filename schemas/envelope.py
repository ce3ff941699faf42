"""What every message has in common: strict validation, a schema name with version, one error."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

MAX_TEXT = 2_000
"""Longest free text in a message, characters."""

Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""Unit quaternion, order x, y, z, w."""

Text = Annotated[str, Field(max_length=MAX_TEXT)]
Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.:-]+$")]
Label = Annotated[str, Field(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9_.:/*-]+$")]
StampNs = Annotated[int, Field(ge=0, lt=2**63)]
"""Integer nanoseconds since the Unix epoch (or since the start of simulated time)."""
Counter = Annotated[int, Field(ge=0, lt=2**63)]
TreeId = Annotated[int, Field(ge=0, lt=2**63)]
"""A tree's number in one map; it fits the 64 bits of the arrays and databases that keep it."""


class DecodeError(ValueError):
    """Bytes that are not the message they should be; the text says what was wrong with them."""


class Message(BaseModel):
    """Base of all messages: immutable, no unknown fields, no NaN or infinity, no silent conversion."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    SCHEMA: ClassVar[str] = ""
    VERSION: ClassVar[int] = 1
    MAX_BYTES: ClassVar[int] = 64 * 1024

    @classmethod
    def schema_id(cls) -> str:
        """Return the name with its version, for example ``treedock.pose@1``."""
        return f"{cls.SCHEMA}@{cls.VERSION}"

    @classmethod
    def encoding(cls) -> str:
        """Return the Zenoh encoding string."""
        return f"application/msgpack;{cls.schema_id()}"


class Part(BaseModel):
    """Base of what is nested in messages, under the same rules."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
