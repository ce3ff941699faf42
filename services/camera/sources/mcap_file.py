"""MCAP files of our frames: one channel per key, schema ``treedock.rgbd``, chunked and compressed with zstd."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from schemas.camera import ColourEncoding, DepthEncoding, RgbdFrame
from schemas.envelope import DecodeError
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, Topic
from services.camera.codecs import FrameError, raw, recode
from services.camera.config import CameraConfig
from services.camera.sources.accelerometer import telling
from services.camera.sources.base import BadFrame
from services.common.errors import InputError

_CHUNK_BYTES = 4 * 1024 * 1024
"""A power cut loses at most the open chunk: a few frames."""
_LARGEST_RECORD = 256 * 1024 * 1024
_SCHEMA_ENCODING = "treedock"
"""Not one of MCAP's well-known encodings: the layout is in schemas/camera.py."""


class FrameWriter:
    """Writes frames to an MCAP file; use it in a ``with`` statement, which completes the file."""

    def __init__(
        self,
        path: Path,
        *,
        uav: str = "uav1",
        topic: Topic = CAMERA_RGBD,
        colour: ColourEncoding = "jpeg",
        depth: DepthEncoding = "png",
        jpeg_quality: int = 90,
    ) -> None:
        from mcap.writer import CompressionType, Writer

        self._formats: tuple[ColourEncoding, DepthEncoding, int] = (colour, depth, jpeg_quality)
        try:
            self._file: BinaryIO = path.open("wb")
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="treedock", library="treedock")
        schema = self._writer.register_schema(RgbdFrame.SCHEMA, _SCHEMA_ENCODING, b"")
        self._channel = self._writer.register_channel(topic.key(uav), RgbdFrame.encoding(), schema)

    def add(self, frame: RgbdFrame) -> None:
        """Append one frame.

        Raises:
            FrameError: its bytes cannot be decoded, so they cannot be recoded.
        """
        stored = recode(frame, *self._formats)
        self._writer.add_message(
            self._channel, frame.stamp_ns, bytes(stored.to_bytes()), frame.stamp_ns, frame.seq & 0xFFFFFFFF
        )

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write the index and close."""
        self._writer.finish()
        self._file.close()


class McapSource:
    """The frames of one MCAP file, from its raw camera channel or else from the compressed one."""

    paced = True
    remark = ""

    def __init__(self, path: Path, config: CameraConfig) -> None:
        if not path.is_file():
            raise InputError(f"{path}: no such file")
        if config.camera_file:
            raise InputError(f"{config.camera_file}: not used: {path} carries its own intrinsics; leave --camera out")
        self.name = str(path)
        self._path = path
        self._topic, self.expected = _frame_topic(path)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield the frames in file order; a cut file ends with a BadFrame that says so."""
        count, last_ns = 0, 0
        for entry in _messages(self._path):
            if isinstance(entry, str):
                yield BadFrame(last_ns, f"{self._path}: {entry} after {count} frames")
                return
            topic, log_time_ns, data = entry
            if topic != self._topic:
                continue
            last_ns = log_time_ns
            yield self._frame(log_time_ns, data, count)
            count += 1

    def _frame(self, log_time_ns: int, data: bytes, number: int) -> RgbdFrame | BadFrame:
        try:
            frame = raw(RgbdFrame.from_bytes(data))
            return dataclasses.replace(frame, accel_camera=telling(frame.accel_camera))
        except (DecodeError, FrameError) as error:
            return BadFrame(log_time_ns, f"{self._path}: message {number}: {error}")


def _messages(path: Path) -> Iterator[tuple[str, int, bytes] | str]:
    """Yield (topic, log time, data) of every frame message; a fault of the file ends it with its description."""
    from mcap.exceptions import EndOfFile, McapError
    from mcap.records import Channel, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, str] = {}
    topics: dict[int, str] = {}
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True, record_size_limit=_LARGEST_RECORD).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    if schemas.get(record.schema_id) == RgbdFrame.SCHEMA:
                        topics[record.id] = record.topic
                elif isinstance(record, Message) and record.channel_id in topics:
                    yield topics[record.channel_id], record.log_time, record.data
        except (EndOfFile, struct.error):
            yield "the recording is cut short"
        except (McapError, ValueError, MemoryError) as error:
            yield f"damaged recording: {str(error)[:120] or type(error).__name__}"
        except _zstd_error() as error:
            yield f"damaged recording: {str(error)[:120]}"


def _zstd_error() -> type[Exception]:
    import zstandard

    return zstandard.ZstdError


def _frame_topic(path: Path) -> tuple[str, int | None]:
    """Return the topic to read and how many frames it has (None when the index is gone).

    Raises:
        InputError: no MCAP file, or one without frames.
    """
    counts = _indexed_counts(path)
    if counts is None:
        first = next(_messages(path), "it holds no frames")
        if isinstance(first, str):
            raise InputError(f"{path}: no usable recording: {first}")
        return first[0], None
    for wanted in (CAMERA_RGBD.name, CAMERA_COMPRESSED.name):
        for topic, count in sorted(counts.items()):
            if topic.endswith("/" + wanted) and count:
                return topic, count
    others = sorted(topic for topic, count in counts.items() if count)
    if others:
        return others[0], counts[others[0]]
    raise InputError(f"{path}: it holds no {RgbdFrame.SCHEMA} frames; was the camera recorded?")


def _indexed_counts(path: Path) -> dict[str, int] | None:
    """Return frames per topic from the file's summary, None when it has none (cut)."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        try:
            summary = make_reader(stream).get_summary()
        except (McapError, struct.error, ValueError, OSError):
            return None
    if summary is None or summary.statistics is None:
        return None
    counts = summary.statistics.channel_message_counts
    return {
        channel.topic: counts.get(channel.id, 0)
        for channel in summary.channels.values()
        if channel.schema_id in summary.schemas and summary.schemas[channel.schema_id].name == RgbdFrame.SCHEMA
    }
