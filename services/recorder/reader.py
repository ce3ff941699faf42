"""The messages of a recording, decoded, in the order they were written."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from schemas.codec import Wire, decode
from schemas.envelope import DecodeError
from schemas.topics import PREFIX, TOPICS, Topic, find
from services.common.errors import InputError

_LARGEST_RECORD = 256 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording."""

    stamp_ns: int
    """When it was recorded."""
    topic: Topic
    leaf: str | None
    message: Wire


def messages(
    path: Path, topics: Collection[Topic] = TOPICS, start_ns: int = 0, end_ns: int = 2**63 - 1
) -> Iterator[Recorded | str]:
    """Yield the messages of ``topics``; a text stands for one that cannot be used, or for the file's premature end.

    Raises:
        InputError: the file cannot be opened.
    """
    from mcap.exceptions import McapError
    from mcap.records import Channel, Message
    from mcap.stream_reader import StreamReader
    from zstandard import ZstdError

    wanted = {topic.name for topic in topics}
    channels: dict[int, tuple[Topic, str | None]] = {}
    try:
        stream = path.open("rb")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    with stream:
        try:
            for record in StreamReader(stream, validate_crcs=True, record_size_limit=_LARGEST_RECORD).records:
                if isinstance(record, Channel):
                    place = _place(record.topic)
                    if place is not None and place[0].name in wanted and record.message_encoding == place[0].encoding:
                        channels[record.id] = place
                elif isinstance(record, Message) and record.channel_id in channels:
                    if not start_ns <= record.log_time <= end_ns:
                        continue
                    yield _decoded(*channels[record.channel_id], record.log_time, record.data)
        except (McapError, ZstdError, struct.error, ValueError, MemoryError) as error:
            yield f"{path}: the recording ends early ({type(error).__name__}); `treedock recordings --recover` mends it"


def _place(key: str) -> tuple[Topic, str | None] | None:
    """Return the topic, and for a ``*`` its leaf, of a full key."""
    if not key.startswith(PREFIX + "/"):
        return None
    name = key.removeprefix(PREFIX + "/").partition("/")[2]
    try:
        topic = find(name)
    except KeyError:
        return None
    return topic, name.rpartition("/")[2] if topic.name.endswith("*") else None


def _decoded(topic: Topic, leaf: str | None, stamp_ns: int, data: bytes) -> Recorded | str:
    try:
        return Recorded(stamp_ns, topic, leaf, decode(topic.message, data))
    except DecodeError as error:
        return f"{topic.name} at {stamp_ns}: {error}"
