"""An Intel RealSense D4xx through pyrealsense2 (optional extra): set from the configuration, found again after unplugging."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame, depth_after
from services.camera.codecs import encode_colour, encode_depth
from services.camera.config import CameraConfig, RealsenseConfig
from services.camera.sources.base import BadFrame
from services.camera.sources.camera_json import read_intrinsics
from services.common.errors import InputError

_SIZE_PX = (640, 480)
_WAIT_MS = 200
"""A frame takes 33 ms; a service that waits longer than this could not stop quickly."""
_RESTART_AFTER_S = 3.0
"""A camera that is there but sends nothing for so long is started again."""
_CLOCK_WITHIN_NS = 1_000_000_000
"""A device's stamp further than this from our time is no time of ours."""
_FAULT_PERIOD_S = 0.2

Device = Any
"""pyrealsense2 ships no types."""


def require_library() -> None:
    """Check that pyrealsense2 is installed.

    Raises:
        InputError: it is not.
    """
    if find_spec("pyrealsense2") is None:
        raise InputError("camera source realsense: pyrealsense2 is missing; pip install pyrealsense2")


class RealsenseSource:
    """Live frames, depth registered to colour by the device's own calibration; it never ends by itself."""

    paced = False
    name = "realsense"
    remark = ""
    expected: int | None = None

    def __init__(
        self,
        config: CameraConfig,
        now_ns: Callable[[], int] = time.time_ns,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Open the camera; ``now_ns`` and ``sleep`` are the clock that arrivals and pauses go by.

        Raises:
            InputError: no library, no camera, or a camera.json that does not fit.
        """
        require_library()
        import pyrealsense2 as rs

        self._rs: Device = rs
        self._settings = config.realsense
        self._now_ns, self._sleep = now_ns, sleep
        self._file = read_intrinsics(Path(config.camera_file)) if config.camera_file else None
        if self._file is not None and (self._file.width, self._file.height) != _SIZE_PX:
            raise InputError(f"{config.camera_file}: {self._file.width}x{self._file.height}, the camera sends 640x480")
        self._pipeline: Device = None
        try:
            self._open()
        except RuntimeError as error:
            raise InputError(f"camera source realsense: {error}; is a camera connected to a USB 3 port?") from None

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield frames as the camera delivers them; while it is away, a BadFrame now and then that says so."""
        seq, heard_ns = 0, self._now_ns()
        try:
            while True:
                fault = "" if self._pipeline is not None else self._reopen()
                if not fault:
                    try:
                        frames = self._align.process(self._pipeline.wait_for_frames(_WAIT_MS))
                        frame = self._frame(frames, seq)
                    except RuntimeError as error:
                        fault = self._judge(heard_ns, str(error))
                    else:
                        seq, heard_ns = seq + 1, self._now_ns()
                        yield frame
                        continue
                yield BadFrame(self._now_ns(), f"realsense: {fault}")
        finally:
            self._close()

    def _judge(self, heard_ns: int, error: str) -> str:
        """Return what is wrong after a missed frame; a camera that is gone or hangs is closed, to be opened anew."""
        silent_s = (self._now_ns() - heard_ns) / 1e9
        if not self._present():
            self._close()
            return "unplugged: waiting for it to come back"
        if silent_s > _RESTART_AFTER_S:
            self._close()
            return f"no frame for {silent_s:.1f} s: starting it again"
        return f"no frame within {_WAIT_MS} ms: {error}"

    def _reopen(self) -> str:
        """Try to open the camera again; returns why not, or nothing."""
        if not self._present():
            self._sleep(min(self._settings.reopen_every_s, _FAULT_PERIOD_S))
            return "unplugged: waiting for it to come back"
        try:
            self._open()
        except RuntimeError as error:
            self._close()
            self._sleep(min(self._settings.reopen_every_s, _FAULT_PERIOD_S))
            return f"it is back but does not start: {error}"
        return ""

    def _present(self) -> bool:
        """Return whether the camera (or, before one was opened, any) is connected."""
        info = self._rs.camera_info.serial_number
        return any(self._wanted(device.get_info(info)) for device in self._rs.context().query_devices())

    def _wanted(self, serial: str) -> bool:
        return serial == self._settings.serial or not self._settings.serial

    def _open(self) -> None:
        rs, settings = self._rs, self._settings
        streams = rs.config()
        if settings.serial:
            streams.enable_device(settings.serial)
        streams.enable_stream(rs.stream.color, *_SIZE_PX, rs.format.bgr8, settings.rate_hz)
        streams.enable_stream(rs.stream.depth, *_SIZE_PX, rs.format.z16, settings.rate_hz)
        pipeline = rs.pipeline()
        profile = pipeline.start(streams)
        self._pipeline = pipeline
        device = profile.get_device()
        depth_sensor = device.first_depth_sensor()
        set_depth_sensor(rs, depth_sensor, settings)
        _set_exposure(rs, device.first_color_sensor(), settings.colour_exposure_us)
        scale = 1.0 / depth_sensor.get_depth_scale()
        stream = profile.get_stream(rs.stream.color).as_video_stream_profile()
        own = _intrinsics(stream.get_intrinsics(), scale)
        self.intrinsics = own if self._file is None else self._file.model_copy(update={"depth_scale": own.depth_scale})
        self._align = rs.align(rs.stream.color)

    def _close(self) -> None:
        pipeline, self._pipeline = self._pipeline, None
        if pipeline is None:
            return
        try:
            pipeline.stop()
        except RuntimeError:  # of a device that is gone, nothing is left to stop
            return

    def _frame(self, frames: Device, seq: int) -> RgbdFrame:
        colour_frame, depth_frame = frames.get_color_frame(), frames.get_depth_frame()
        if not colour_frame or not depth_frame:
            raise RuntimeError("colour or depth is missing from the pair")
        colour_ns, depth_ns = self._taken_ns(colour_frame), self._taken_ns(depth_frame)
        apart_ns = 0 if colour_ns is None or depth_ns is None else depth_after(colour_ns, depth_ns)
        return RgbdFrame(
            stamp_ns=self._now_ns() if colour_ns is None else colour_ns, seq=seq, intrinsics=self.intrinsics,
            colour=encode_colour(np.asanyarray(colour_frame.get_data()), "bgr8"),
            depth=encode_depth(np.asanyarray(depth_frame.get_data()), "z16"),
            depth_after_ns=apart_ns,
        )  # fmt: skip

    def _taken_ns(self, frame: Device) -> int | None:
        """Return when the image was taken by the device's clock where the library maps it to ours, else None: on arrival."""
        mapped = (self._rs.timestamp_domain.global_time, self._rs.timestamp_domain.system_time)
        if not self._settings.global_time or frame.get_frame_timestamp_domain() not in mapped:
            return None
        stamp_ns = round(frame.get_timestamp() * 1e6)
        return stamp_ns if abs(self._now_ns() - stamp_ns) < _CLOCK_WITHIN_NS else None


def set_depth_sensor(rs: Device, sensor: Device, settings: RealsenseConfig) -> None:
    """Set preset, projector, power and exposure, each where the device has it."""
    option = rs.option
    if settings.preset != "keep" and sensor.supports(option.visual_preset):
        sensor.set_option(option.visual_preset, float(int(getattr(rs.rs400_visual_preset, settings.preset))))
    if sensor.supports(option.emitter_enabled):
        sensor.set_option(option.emitter_enabled, float(settings.projector))
    if settings.projector and sensor.supports(option.laser_power):
        power = sensor.get_option_range(option.laser_power)
        steps = round((settings.laser_power_share * power.max - power.min) / power.step)
        sensor.set_option(option.laser_power, max(power.min, power.min + steps * power.step))
    if sensor.supports(option.global_time_enabled):
        sensor.set_option(option.global_time_enabled, float(settings.global_time))
    _set_exposure(rs, sensor, settings.depth_exposure_us)


def _set_exposure(rs: Device, sensor: Device, exposure_us: float | None) -> None:
    option = rs.option
    if sensor.supports(option.enable_auto_exposure):
        sensor.set_option(option.enable_auto_exposure, float(exposure_us is None))
    if exposure_us is not None and sensor.supports(option.exposure):
        allowed = sensor.get_option_range(option.exposure)
        sensor.set_option(option.exposure, min(max(exposure_us, allowed.min), allowed.max))


def _intrinsics(device: Device, depth_scale: float) -> Intrinsics:
    k1, k2, p1, p2, k3 = (float(c) for c in device.coeffs)
    return Intrinsics(
        width=int(device.width), height=int(device.height), fx=float(device.fx), fy=float(device.fy),
        cx=float(device.ppx), cy=float(device.ppy), k1=k1, k2=k2, p1=p1, p2=p2, k3=k3, depth_scale=float(depth_scale),
    )  # fmt: skip
