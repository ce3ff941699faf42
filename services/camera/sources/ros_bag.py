"""ROS bags as a source: ROS 1 ``.bag``, ROS 2 folders and their .db3 and .mcap files; read with the rosbags package.

Colour and depth are paired by the stamps of their headers, as in a TUM folder.
"""

from __future__ import annotations

import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics, RgbdFrame, depth_after
from services.camera.codecs import FrameError, encode_colour, encode_depth
from services.camera.config import CameraConfig
from services.camera.sources.associate import associate, unpaired
from services.camera.sources.base import BadFrame
from services.camera.sources.camera_json import read_intrinsics
from services.camera.sources.registration import registration_for
from services.camera.sources.ros_images import MILLIMETRES, colour_of, depth_of, intrinsics_of, kind_of
from services.common.errors import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_IMAGE, _COMPRESSED, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_ROS1_MAGIC, _SQLITE_MAGIC, _MCAP_MAGIC = b"#ROSBAG V", b"SQLite format 3\0", b"\x89MCAP0\r\n"
_REGISTERED = ("aligned_depth_to_color", "depth_registered", "registered", "hw_registered")
_NOT_COLOUR = ("infra", "ir/", "left", "right", "confidence", "disparity")
_ALONE_SHARE = 0.1
_MAX_PENDING = 400
"""Images kept for a partner that comes later in the bag."""


@dataclass(frozen=True, slots=True)
class Topics:
    """Which topics of a bag are the camera's."""

    colour: str
    depth: str
    info: str
    """Empty: the bag has no CameraInfo for the colour images."""


def is_ros(path: Path) -> bool:
    """Return whether a path is a ROS bag (and not one of our MCAP files or a TUM folder)."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() and not (path / "camera.json").exists()
    with path.open("rb") as file:
        head = file.read(64)
    if head.startswith(_MCAP_MAGIC):  # opcode, length, then the profile's length and name
        (length,) = struct.unpack_from("<I", head, 17) if len(head) >= 21 else (0,)
        return head[21 : 21 + length].startswith(b"ros")
    return head.startswith((_ROS1_MAGIC, _SQLITE_MAGIC)) or path.suffix == ".bag"


class BagSource:
    """The frames of one ROS bag."""

    paced = True

    def __init__(self, path: Path, config: CameraConfig) -> None:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        self.name = str(path)
        self._path = path
        within_ns = round(config.associate_within_s * 1e9)
        with _opened(path) as reader:
            self.topics = choose_topics(reader, path, config)
            stamps = _stamps(reader, self.topics)
            colour_ns, depth_ns = (np.array(stamps[t], dtype=np.int64) for t in (self.topics.colour, self.topics.depth))
            for topic, stamps_ns in ((self.topics.colour, colour_ns), (self.topics.depth, depth_ns)):
                _refuse_repeated(path, topic, stamps_ns)
            self._pairs = dict(associate(colour_ns, depth_ns, within_ns))
            if not self._pairs:
                raise InputError(f"{path}: no frames: {unpaired(colour_ns, depth_ns, within_ns)}")
            self.remark = _left_out(len(colour_ns), len(self._pairs), within_ns)
            self.intrinsics, self._registration = self._cameras(reader, config)
        self._colour_ns, self._depth_ns = colour_ns, depth_ns
        self.expected: int | None = len(self._pairs)

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield the paired frames in the order in which their colour images were recorded."""
        wanted_depth = set(self._pairs.values())
        order = sorted(self._pairs)
        colours: dict[int, Any] = {}
        depths: dict[int, Any] = {}
        seen = {self.topics.colour: -1, self.topics.depth: -1}
        done = 0
        errors: tuple[type[Exception], ...] = (InputError, *_read_errors())
        try:
            with _opened(self._path) as reader:
                for topic, message in _messages(reader, self.topics):
                    seen[topic] += 1
                    number = seen[topic]
                    if topic == self.topics.colour and number in self._pairs:
                        colours[number] = message
                    elif topic == self.topics.depth and number in wanted_depth:
                        depths[number] = message
                    while done < len(order) and order[done] in colours and self._pairs[order[done]] in depths:
                        k = order[done]
                        yield self._frame(k, colours.pop(k), depths.pop(self._pairs[k]), done)
                        done += 1
                    if len(colours) + len(depths) > _MAX_PENDING:
                        raise InputError(f"colour and depth are more than {_MAX_PENDING} images apart in the file")
        except errors as error:
            last_ns = int(self._colour_ns[order[max(done - 1, 0)]])
            yield BadFrame(last_ns, f"{self._path}: {_line(error)} after {done} frames")

    def _frame(self, number: int, colour: Any, depth: Any, seq: int) -> RgbdFrame | BadFrame:  # noqa: ANN401
        stamp_ns, camera, registration = int(self._colour_ns[number]), self.intrinsics, self._registration
        depth_camera = registration.camera if registration else camera
        try:
            bgr = colour_of(colour, camera.width, camera.height)
            raw, scale = depth_of(depth, depth_camera.width, depth_camera.height)
        except FrameError as error:
            return BadFrame(stamp_ns, f"{self._path}: frame {number}: {error}")
        if registration is not None:
            raw, scale = registration.apply(raw, scale), camera.depth_scale
        if scale != camera.depth_scale:
            camera = self.intrinsics = camera.model_copy(update={"depth_scale": scale})
        return RgbdFrame(
            stamp_ns=stamp_ns, seq=seq, intrinsics=camera, colour=encode_colour(bgr, "bgr8"),
            depth=encode_depth(raw, "z16"),
            depth_after_ns=depth_after(stamp_ns, int(self._depth_ns[self._pairs[number]])),
        )  # fmt: skip

    def _cameras(self, reader: AnyReader, config: CameraConfig) -> tuple[Intrinsics, Any]:
        if config.camera_file:
            camera = read_intrinsics(Path(config.camera_file))
        elif self.topics.info:
            info = next(message for _, message in _messages(reader, self.topics, self.topics.info))
            try:
                camera = intrinsics_of(info, self.topics.colour, MILLIMETRES)
            except FrameError as error:
                raise InputError(f"{self._path}: {self.topics.info}: {error}; name intrinsics with --camera") from None
        else:
            raise InputError(f"{self._path}: no CameraInfo beside {self.topics.colour}; name intrinsics with --camera")
        return camera, registration_for(config, camera)


def choose_topics(reader: AnyReader, path: Path, config: CameraConfig) -> Topics:
    """Return the bag's colour, depth and CameraInfo topics: the configured ones, else the likeliest.

    Raises:
        InputError: none, with the image topics that there are.
    """
    images = sorted({c.topic for c in reader.connections if c.msgtype in (_IMAGE, _COMPRESSED) and c.msgcount})
    kinds: dict[str, str] = {}
    for topic in images:
        connection = next(c for c in reader.connections if c.topic == topic and c.msgcount)
        first = next(iter(reader.messages([connection])), None)
        kinds[topic] = "" if first is None else kind_of(reader.deserialize(first[2], connection.msgtype))
    chosen = {}
    for kind, wanted in (("colour", config.bag_colour_topic), ("depth", config.bag_depth_topic)):
        found = [t for t in images if (t == wanted if wanted else kinds[t] == kind)]
        if not found:
            listed = ", ".join(images) or "none"
            raise InputError(f"{path}: no {wanted or kind + ' images'}; the image topics are: {listed}")
        chosen[kind] = min(found, key=_depth_rank if kind == "depth" else _colour_rank)
    infos = sorted(c.topic for c in reader.connections if c.msgtype == _INFO and c.msgcount)
    return Topics(chosen["colour"], chosen["depth"], _info_for(chosen["colour"], infos))


def _refuse_repeated(path: Path, topic: str, stamps_ns: NDArray[np.int64]) -> None:
    values, counts = np.unique(stamps_ns, return_counts=True)
    if len(counts) and counts.max() > 1 and counts.max() > _ALONE_SHARE * len(stamps_ns):
        raise InputError(
            f"{path}: {topic}: {counts.max()} of {len(stamps_ns)} images have the header stamp "
            f"{values[counts.argmax()] * 1e-9:.3f} s: the driver does not fill it in, so no image can be paired by it"
        )


def _left_out(colours: int, pairs: int, within_ns: int) -> str:
    alone = colours - pairs
    if alone <= _ALONE_SHARE * colours:
        return ""
    return f"{alone} of {colours} colour images have no depth image within {within_ns / 1e6:.0f} ms"


def _depth_rank(topic: str) -> tuple[bool, bool, str]:
    return not any(word in topic for word in _REGISTERED), "compressed" in topic, topic


def _colour_rank(topic: str) -> tuple[bool, bool, bool, str]:
    named = any(word in topic for word in ("color", "colour", "rgb"))
    return any(word in topic for word in _NOT_COLOUR), not named, "compressed" in topic, topic


def _info_for(colour: str, infos: list[str]) -> str:
    """Return the CameraInfo of an image topic: the one in its namespace, or in the next one above."""
    space = colour
    while "/" in space:
        space = space.rsplit("/", 1)[0]
        if f"{space}/camera_info" in infos:
            return f"{space}/camera_info"
    return infos[0] if len(infos) == 1 else ""


def _stamps(reader: AnyReader, topics: Topics) -> dict[str, list[int]]:
    """Return the header stamps of the two image topics in the order of the file, without decoding the images."""
    at = 4  # ROS 1: behind the header's sequence number; CDR: behind the encapsulation
    found: dict[str, list[int]] = {topics.colour: [], topics.depth: []}
    connections = [c for c in reader.connections if c.topic in found]
    for connection, _, data in reader.messages(connections):
        form = ">II" if reader.is2 and data[1] == 0 else "<II"
        seconds, nanoseconds = struct.unpack_from(form, data, at)
        found[connection.topic].append(seconds * 1_000_000_000 + nanoseconds)
    return found


def _messages(reader: AnyReader, topics: Topics, only: str = "") -> Iterator[tuple[str, Any]]:
    wanted = (only,) if only else (topics.colour, topics.depth)
    connections = [c for c in reader.connections if c.topic in wanted]
    for connection, _, data in reader.messages(connections):
        yield connection.topic, reader.deserialize(data, connection.msgtype)


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """Open a bag; whatever its reader finds wrong becomes an InputError."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except _read_errors() as error:
        raise InputError(f"{path}: not a usable ROS bag: {_line(error)}") from None


def _read_errors() -> tuple[type[Exception], ...]:
    """Return what rosbags and what it reads with raise for a damaged file."""
    from rosbags.highlevel import AnyReaderError
    from rosbags.rosbag1 import ReaderError as Reader1Error
    from rosbags.rosbag2 import ReaderError as Reader2Error
    from rosbags.serde import SerdeError

    return (
        AnyReaderError, Reader1Error, Reader2Error, SerdeError, struct.error, zlib.error, sqlite3.Error, OSError,
        KeyError, ValueError, IndexError, AssertionError,
    )  # fmt: skip


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
