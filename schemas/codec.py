"""Bytes to messages and back. Decoding never trusts: whatever arrives gives a message or one DecodeError."""

from __future__ import annotations

from typing import Any, Protocol, Self, TypeVar

import msgpack
from pydantic import ValidationError

from schemas.envelope import DecodeError, Message

M = TypeVar("M", bound="Wire")

_SCHEMA_KEY = "schema"
_MAX_DEPTH_ERRORS = (ValueError, TypeError, RecursionError, OverflowError)


class Wire(Protocol):
    """A message class the codec can carry: msgpack models, or binary ones with to_bytes and from_bytes."""

    @classmethod
    def encoding(cls) -> str:
        """Return the Zenoh encoding string."""
        ...


class BinaryWire(Protocol):
    """A message with a layout of its own."""

    def to_bytes(self) -> bytearray:
        """Return the message's bytes."""
        ...

    @classmethod
    def from_bytes(cls, data: bytes | bytearray | memoryview) -> Self:
        """Parse, or raise DecodeError."""
        ...


def encode(message: Wire) -> bytes | bytearray:
    """Return the bytes of any message of ``schemas``."""
    if isinstance(message, Message):
        body: dict[str, Any] = {_SCHEMA_KEY: message.schema_id()}
        body.update(message.model_dump(mode="python"))
        return bytes(msgpack.packb(body, use_bin_type=True))
    return message.to_bytes()  # type: ignore[attr-defined, no-any-return]


def decode(kind: type[M], data: bytes | bytearray | memoryview) -> M:
    """Return the message of class ``kind`` in ``data``.

    Raises:
        DecodeError: truncated, oversized, NaN-poisoned, of another schema or version, or random bytes.
    """
    if not issubclass(kind, Message):
        return kind.from_bytes(data)  # type: ignore[attr-defined, no-any-return]
    body = unpack(data, kind.MAX_BYTES)
    found = body.pop(_SCHEMA_KEY, None)
    if found != kind.schema_id():
        raise DecodeError(f"expected {kind.schema_id()}, found {str(found)[:80]!r}")
    try:
        return kind.model_validate(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DecodeError(f"{kind.schema_id()}: {where}: {first['msg']}"[:500]) from None


def unpack(data: bytes | bytearray | memoryview, max_bytes: int) -> dict[str, Any]:
    """Return the msgpack map in ``data`` without validating its fields.

    Raises:
        DecodeError: when it is too large, or is not one whole msgpack map with text keys.
    """
    if len(data) > max_bytes:
        raise DecodeError(f"message of {len(data)} bytes, at most {max_bytes} are accepted")
    try:
        body = msgpack.unpackb(data, use_list=False, raw=False, strict_map_key=True)
    except _MAX_DEPTH_ERRORS as error:
        raise DecodeError(f"not msgpack: {type(error).__name__}: {str(error)[:120]}") from None
    except msgpack.UnpackException as error:
        raise DecodeError(f"not msgpack: {type(error).__name__}: {str(error)[:120]}") from None
    if not isinstance(body, dict):
        raise DecodeError(f"expected a msgpack map, found {type(body).__name__}")
    return body
