"""A pyrealsense2 of our own for tests: one camera that can be unplugged, plugged in, hung, and asked how it was set."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

COLOUR_EXPOSURE_UNIT_US = 100.0
SIZE = (640, 480)


class Frame:
    def __init__(self, data: np.ndarray, stamp_ms: float, domain: str) -> None:
        self._data, self._stamp_ms, self._domain = data, stamp_ms, domain

    def get_data(self) -> np.ndarray:
        return self._data

    def get_timestamp(self) -> float:
        return self._stamp_ms

    def get_frame_timestamp_domain(self) -> str:
        return self._domain


class Sensor:
    def __init__(self, options: dict[str, tuple[float, float, float]]) -> None:
        self.ranges, self.set = options, dict[str, float]()

    def supports(self, option: str) -> bool:
        return option in self.ranges

    def get_option_range(self, option: str) -> Any:
        low, high, step = self.ranges[option]
        return SimpleNamespace(min=low, max=high, step=step)

    def set_option(self, option: str, value: float) -> None:
        low, high, _ = self.ranges[option]
        assert low <= value <= high, f"{option} {value}"
        self.set[option] = value

    def get_depth_scale(self) -> float:
        return 0.001


class Camera:
    """The state behind the module."""

    def __init__(self) -> None:
        self.now_ns = 10**18
        self.plugged, self.hung, self.starts, self.stops, self.frame = True, False, 0, 0, 0
        self.domain, self.depth_late_ms = "global_time", 0.0
        self.streams: list[tuple[Any, ...]] = []
        self.depth = Sensor({
            "visual_preset": (0, 6, 1), "emitter_enabled": (0, 1, 1), "laser_power": (0, 360, 30),
            "enable_auto_exposure": (0, 1, 1), "exposure": (1, 165000, 1), "global_time_enabled": (0, 1, 1),
        })  # fmt: skip
        self.colour = Sensor({"enable_auto_exposure": (0, 1, 1), "exposure": (1, 10000, 1)})
        self.slept_s = 0.0

    def sleep(self, seconds: float) -> None:
        self.slept_s += seconds
        self.now_ns += round(seconds * 1e9)

    def take(self, wait_ms: int) -> Any:
        if not self.plugged or self.hung:
            self.now_ns += wait_ms * 10**6
            raise RuntimeError(f"Frame didn't arrive within {wait_ms}")
        self.now_ns += 33_000_000
        self.frame += 1
        rng = np.random.default_rng(self.frame)
        colour = np.broadcast_to(rng.integers(0, 255, (480, 1, 3), dtype=np.uint8), (480, 640, 3)).copy()
        depth = np.full((480, 640), 1500 + self.frame, np.uint16)
        stamp_ms = (self.now_ns - 20_000_000) / 1e6
        frames = (Frame(colour, stamp_ms, self.domain), Frame(depth, stamp_ms + self.depth_late_ms, self.domain))
        return SimpleNamespace(get_color_frame=lambda: frames[0], get_depth_frame=lambda: frames[1])


def module(camera: Camera) -> ModuleType:
    """Return the module that stands for pyrealsense2."""
    made = ModuleType("pyrealsense2")
    device = SimpleNamespace(
        first_depth_sensor=lambda: camera.depth, first_color_sensor=lambda: camera.colour, get_info=lambda _: "123"
    )
    intrinsics = SimpleNamespace(width=640, height=480, fx=610.0, fy=611.0, ppx=320.0, ppy=240.0, coeffs=[0.0] * 5)
    video = SimpleNamespace(as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: intrinsics))
    profile = SimpleNamespace(get_device=lambda: device, get_stream=lambda _: video)

    class Pipeline:
        def start(self, config: Any) -> Any:
            if not camera.plugged:
                raise RuntimeError("No device connected")
            camera.starts += 1
            camera.streams = config.streams
            camera.hung = False
            return profile

        def stop(self) -> None:
            camera.stops += 1
            if not camera.plugged:
                raise RuntimeError("stop() cannot be called: the device is gone")

        def wait_for_frames(self, wait_ms: int) -> Any:
            return camera.take(wait_ms)

    class Config:
        def __init__(self) -> None:
            self.streams: list[tuple[Any, ...]] = []

        def enable_stream(self, *stream: Any) -> None:
            self.streams.append(stream)

        def enable_device(self, serial: str) -> None:
            self.streams.append(("serial", serial))

    names = {name: name for name in camera.depth.ranges}
    made.__dict__.update(
        pipeline=Pipeline, config=Config, align=lambda _: SimpleNamespace(process=lambda frames: frames),
        context=lambda: SimpleNamespace(query_devices=lambda: [device] if camera.plugged else []),
        stream=SimpleNamespace(color="color", depth="depth"), format=SimpleNamespace(bgr8="bgr8", z16="z16"),
        camera_info=SimpleNamespace(serial_number="serial"), option=SimpleNamespace(**names),
        rs400_visual_preset=SimpleNamespace(default=1, hand=2, high_accuracy=3, high_density=4, medium_density=5),
        timestamp_domain=SimpleNamespace(
            global_time="global_time", system_time="system_time", hardware_clock="hardware_clock"
        ),
    )  # fmt: skip
    made.__spec__ = SimpleNamespace(name="pyrealsense2")  # type: ignore[assignment]
    return made
