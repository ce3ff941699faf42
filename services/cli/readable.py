"""Payloads as people read them: any sample of ours as plain values, with big byte strings summarised."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
from pydantic import BaseModel

from schemas import command
from schemas.camera import RgbdFrame
from schemas.codec import decode, unpack
from schemas.envelope import DecodeError, Message
from schemas.mapping import Submap
from schemas.topics import PREFIX, TOPICS, Topic, find

_MAX_SHOWN_BYTES = 32
_MAX_SHOWN_ITEMS = 8
_REPLIES: tuple[type[Message], ...] = (command.CommandReply, command.NonceReply)
"""Messages that no row of the table names: they come as replies only."""


def topic_of(key: str) -> Topic:
    """Return the topic of a full key such as ``treedock/v1/uav1/slam/pose``.

    Raises:
        KeyError: the key is none of ours.
    """
    parts = key.split("/")
    prefix = PREFIX.split("/")
    if parts[: len(prefix)] != prefix or len(parts) <= len(prefix) + 1:
        raise KeyError(f"{key!r} is not below {PREFIX}/{{uav}}/")
    return find("/".join(parts[len(prefix) + 1 :]))


def read(key: str, payload: bytes) -> Message | RgbdFrame | Submap:
    """Return the message in ``payload``, as its key and its own schema name tell.

    Raises:
        KeyError: an unknown key.
        DecodeError: bytes that are no message of this key.
    """
    kind: Any = topic_of(key).message
    if issubclass(kind, Message):
        schema = unpack(payload, max(kind.MAX_BYTES, Message.MAX_BYTES)).get("schema")
        kind = next((k for k in _message_kinds() if k.schema_id() == schema), kind)
    message: Message | RgbdFrame | Submap = decode(kind, payload)
    return message


def _message_kinds() -> list[type[Message]]:
    kinds: list[type[Message]] = [t.message for t in TOPICS if issubclass(t.message, Message)]
    return [*kinds, *_REPLIES]


def plain(value: object, *, whole: bool = False) -> Any:  # noqa: ANN401 - JSON has no narrower type
    """Return ``value`` as JSON values; bytes and arrays as a word about them, long lists cut unless ``whole``."""
    if isinstance(value, BaseModel):
        return {name: plain(getattr(value, name), whole=whole) for name in type(value).model_fields}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name), whole=whole) for f in dataclasses.fields(value)}
    if isinstance(value, (bytes, bytearray, memoryview)):
        raw = bytes(value)
        return raw.hex() if len(raw) <= _MAX_SHOWN_BYTES else f"<{len(raw)} bytes>"
    if isinstance(value, np.ndarray):
        size = value.size
        return value.tolist() if size <= 16 else f"<{value.dtype} {'x'.join(map(str, value.shape))}>"
    if isinstance(value, dict):
        return {str(k): plain(v, whole=whole) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        shown = value if whole else value[:_MAX_SHOWN_ITEMS]
        rest = [f"... {len(value) - len(shown)} more"] if len(shown) < len(value) else []
        return [plain(item, whole=whole) for item in shown] + rest
    return value


def text(key: str, payload: bytes, *, whole: bool = False) -> str:
    """Return one line of JSON for a sample; what cannot be read is told in place of it."""
    try:
        return json.dumps(plain(read(key, payload), whole=whole), ensure_ascii=False)
    except (KeyError, DecodeError) as error:
        words = error.args[0] if error.args else error
        return json.dumps({"undecodable": str(words)[:300], "bytes": len(payload), "begins": payload[:16].hex()})
