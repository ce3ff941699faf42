"""Recordings for the recorder's tests, and an entry for its drain."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame
from schemas.topics import CAMERA_COMPRESSED, SLAM_POSE, TREES_LIST, VEHICLE_STATE
from services.camera.codecs import encode_colour, encode_depth
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.memory import Hub
from services.recorder.config import RecorderConfig
from services.recorder.drain import Drain, Entry
from services.recorder.service import build
from tests.examples import all_messages

INTRINSICS = Intrinsics(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)


MB = 1_000_000


def frame(number: int) -> RgbdFrame:
    rng = np.random.default_rng(number)
    colour = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    depth = rng.integers(500, 5000, (48, 64)).astype(np.uint16)
    return RgbdFrame(
        stamp_ns=1_000_000_000 + number * 66_666_667, seq=number, intrinsics=INTRINSICS,
        colour=encode_colour(colour, "jpeg"), depth=encode_depth(depth, "zstd"), colour_encoding="jpeg", depth_encoding="zstd",
    )  # fmt: skip


def example(kind: type) -> Any:
    return next(e for e in all_messages().values() if type(e) is kind)


def recorded(folder: Path, frames: int = 12) -> Path:
    hub = Hub(TreedockConfig(recorder=RecorderConfig(folder=folder, reserve_mb=0)))
    service = build(cast("Context", hub.context("recorder")))
    other = hub.context("camera")
    for number in range(frames):
        hub.advance_to(frame(number).stamp_ns)
        other.publish(CAMERA_COMPRESSED, frame(number))
        for topic in (SLAM_POSE, TREES_LIST, VEHICLE_STATE):
            message = example(topic.message)
            other.publish(topic, message)
        hub.run()
    hub.stop()
    assert service.drain is not None
    assert service.drain.trouble == ""
    return next(folder.glob("*.mcap"))


def cut_at(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def entry(size: int, *, heavy: bool = False) -> Entry:
    return Entry("treedock/v1/uav1/x", "s", "e", bytes(size), 1, 0, heavy)


def settled(drain: Drain, name: str, value: int) -> None:
    deadline = time.monotonic() + 10.0
    while drain.counters[name] < value and time.monotonic() < deadline:
        time.sleep(0.02)
    assert drain.counters[name] >= value
