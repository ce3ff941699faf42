"""Everything that reads bytes from outside: how to feed it, and the errors it may answer with."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import common as mav

from schemas.codec import Wire, decode, encode
from schemas.envelope import DecodeError
from services.camera.calibrated import calibrated_on
from services.camera.codecs import FrameError, decode_colour_image, decode_depth
from services.camera.config import CameraConfig
from services.camera.sources import open_recording
from services.camera.sources.accelerometer import Accelerometer
from services.camera.sources.camera_json import read_camera
from services.common.config_loader import load
from services.common.errors import InputError
from services.detector.names import framed
from services.detector.names import unpack as unpack_tree_ids
from services.detector.readers import read_cloud
from services.mapper.saved_map import SavedMapError, unpack
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.link import Codec
from services.recorder.reader import messages
from services.recorder.recover import recover
from services.security.register import Register
from services.slam.store import records
from services.station.requests import parse
from tests.camera_data import CAMERA, write_tum
from tests.examples import all_messages
from tests.fuzz import seeds

WIDTH, HEIGHT = int(CAMERA["width"]), int(CAMERA["height"])
NOW_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class Target:
    """One reader of foreign bytes."""

    seeds: Sequence[bytes]
    read: Callable[[bytes, Path], object]
    """Called with the bytes and an empty folder."""
    answers: tuple[type[Exception], ...]
    """Errors that are an answer; any other is a bug."""
    slow: int = 1
    """Divides the number of cases."""


def _message(kind: type[Wire]) -> Callable[[bytes, Path], object]:
    def read(data: bytes, _: Path) -> object:
        message = decode(kind, data)
        return encode(message)

    return read


def _file(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], object]:
    def run(data: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return run


def _cloud(path: Path) -> None:
    cloud = read_cloud(path)
    assert cloud.points_m.ndim == 2
    assert np.isfinite(cloud.points_m).all()


def _recording(path: Path) -> None:
    for item in itertools.islice(open_recording(path, CameraConfig()), 10):
        assert item is not None


def _tum(list_name: str) -> Callable[[bytes, Path], object]:
    def run(data: bytes, folder: Path) -> None:
        if not (folder / "camera.json").exists():
            write_tum(folder, 2, accelerometer=True)
        before = (folder / list_name).read_bytes()
        (folder / list_name).write_bytes(data)
        try:
            _recording(folder)
        finally:
            (folder / list_name).write_bytes(before)

    return run


def _camera_file(path: Path) -> None:
    calibrated_on(path)
    read_camera(path)


def _recover(path: Path) -> None:
    for left in path.parent.glob("*.cut"):
        left.unlink()
    recover(path)


def _slam_log(data: bytes, _: Path) -> None:
    for _kind, body in records(data):
        assert isinstance(body, bytes)


def _tree_ids(data: bytes, _: Path) -> object:
    """The checksum is put right, so that damage reaches what lies behind it."""
    return unpack_tree_ids(framed(data)).tracked()


def _text(data: bytes, _: Path) -> object:
    return parse(data.decode(errors="replace"))


def _take(bridge: Bridge, codec: Codec, data: bytes) -> None:
    """Have the bridge take a stretch of bytes; what it then says must still be sound."""
    for message, received_ns in codec.take(data, lambda _: None):
        bridge.handle(message, received_ns)
    for out in bridge.tick(NOW_NS):
        codec.pack(out)
    encode(bridge.state(NOW_NS))


def _mavlink(data: bytes, _: Path) -> None:
    bridge, codec = Bridge(AutopilotConfig()), Codec(191, 1, lambda: NOW_NS)
    _take(bridge, codec, FRAMES[0])
    _take(bridge, codec, data)


def _mavlink_sealed(data: bytes, _: Path) -> None:
    """Take the bytes as the payload of each message: under a right checksum they reach the bridge."""
    bridge, codec = Bridge(AutopilotConfig()), Codec(191, 1, lambda: NOW_NS)
    _take(bridge, codec, FRAMES[0])
    for kind in (type(message) for message in seeds.mavlink_messages()):
        _take(bridge, codec, _sealed(kind, data))


def _sealed(kind: Any, payload: bytes) -> bytes:
    body = payload[:255].rstrip(b"\0") or b"\0"
    head = bytes([len(body), 0, 0, 0, 1, 1]) + int(kind.id).to_bytes(3, "little")
    check = mav.x25crc(head + body + bytes([kind.crc_extra]))
    return b"\xfd" + head + body + check.crc.to_bytes(2, "little")


def _frames() -> list[bytes]:
    writer = mav.MAVLink(None, srcSystem=1, srcComponent=1)
    return [bytes(message.pack(writer)) for message in seeds.mavlink_messages()]


FRAMES = _frames()
_PAYLOADS = [frame[10:-2] for frame in FRAMES]
_FILE = (InputError,)

TARGETS: dict[str, Target] = {
    **{f"message {name}": Target([bytes(encode(example))], _message(type(example)), (DecodeError,))
       for name, example in all_messages().items()},
    "mavlink stream": Target([b"".join(FRAMES), *FRAMES], _mavlink, ()),
    "mavlink payloads": Target(_PAYLOADS, _mavlink_sealed, (), slow=4),
    "cloud ply": Target([seeds.ply()], _file("a.ply", _cloud), _FILE),
    "cloud pcd": Target([seeds.pcd(), seeds.pcd_text()], _file("a.pcd", _cloud), _FILE),
    "cloud las": Target([seeds.las(compressed=False)], _file("a.las", _cloud), _FILE),
    "cloud laz": Target([seeds.las(compressed=True)], _file("a.laz", _cloud), _FILE, slow=5),
    "cloud xyz": Target([seeds.xyz()], _file("a.xyz", _cloud), _FILE),
    "colour image": Target(seeds.images(), lambda data, _: decode_colour_image(data, WIDTH, HEIGHT), (FrameError,)),
    "depth png": Target(seeds.depths()[:1], lambda data, _: decode_depth(data, "png", WIDTH, HEIGHT), (FrameError,)),
    "depth zstd": Target(seeds.depths()[1:], lambda data, _: decode_depth(data, "zstd", WIDTH, HEIGHT), (FrameError,)),
    "recording mcap": Target([seeds.mcap()], _file("a.mcap", _recording), _FILE, slow=2),
    "recording mcap messages": Target([seeds.mcap()], _file("a.mcap", lambda path: list(messages(path))), _FILE, slow=2),
    "recording mcap recovery": Target([seeds.mcap()], _file("a.mcap", _recover), _FILE, slow=2),
    "recording ros bag": Target([seeds.ros_bag()], _file("a.bag", _recording), _FILE, slow=4),
    "tum list": Target([seeds.tum_list()], _tum("rgb.txt"), _FILE, slow=2),
    "tum camera.json": Target([seeds.camera_json()], _file("camera.json", _camera_file), _FILE),
    "accelerometer.txt": Target([seeds.accelerometer()], _file("a.txt", Accelerometer.from_file), _FILE),
    "configuration toml": Target([seeds.toml()], _file("a.toml", lambda path: load(path, environ={})), _FILE, slow=2),
    "configuration json": Target([seeds.json_config()], _file("a.json", lambda path: load(path, environ={})), _FILE, slow=2),
    "certificates list": Target([seeds.certificates()], _file(Register.FILE, lambda path: Register.read(path.parent)), _FILE),
    "map of slam": Target([seeds.slam_log()], _slam_log, ()),
    "tree ids": Target([seeds.tree_ids()], _tree_ids, (ValueError,)),
    "map of mapper": Target([seeds.mapper_map()], lambda data, _: unpack(data), (SavedMapError,)),
    "page request": Target(seeds.page_requests(), _text, (DecodeError,)),
}  # fmt: skip
