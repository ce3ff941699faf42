"""The camera process: frames from a source to ``camera/rgbd``, at the source's pace."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from schemas.camera import ColourEncoding, RgbdFrame
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SIM_RGBD
from services.camera.codecs import FrameError, raw, recode
from services.camera.config import CameraConfig
from services.camera.ranging import limit_frame
from services.camera.sources import BadFrame, Source, open_source
from services.common.context import Context

_TICK_S = 0.005
_KEPT_NOTE_FRAMES = 30
"""A bad frame is told in health until this many good ones came after it."""


def build(context: Context) -> CameraService:
    """Open the configured source and register the work.

    Raises:
        InputError: the source cannot be opened.
    """
    config: CameraConfig = context.config.camera
    service = CameraService(context, config)
    if config.source == "sim":
        context.on(SIM_RGBD, service.on_simulated)
    else:
        replay = Replay(service, open_source(config.source, config), config)
        context.every(_TICK_S, replay.tick)
    return service


class CameraService:
    """Publishes good frames, counts and tells the bad ones."""

    def __init__(self, context: Context, config: CameraConfig) -> None:
        self.context = context
        self._config = config
        self._good_in_a_row = 0

    def on_simulated(self, frame: RgbdFrame) -> None:
        """Pass on a frame of the simulated sensor."""
        try:
            with self.context.health.timed("frame"):
                limited = limit_frame(raw(frame), self._config.min_range_m, self._config.max_range_m)
        except FrameError as error:
            self.drop(str(error))
            return
        self.publish(limited)

    def publish(self, frame: RgbdFrame) -> None:
        """Send a frame; also compressed when somebody listens to that."""
        health = self.context.health
        self.context.publish(CAMERA_RGBD, frame)
        if self.context.listened(CAMERA_COMPRESSED):
            with health.timed("compress"):
                colour: ColourEncoding = "none" if frame.colour_encoding == "none" else "jpeg"
                packed = recode(frame, colour, self._config.compressed_depth, self._config.jpeg_quality)
            self.context.publish(CAMERA_COMPRESSED, packed)
        health.count("frames")
        self._good_in_a_row += 1
        if self._good_in_a_row >= _KEPT_NOTE_FRAMES:
            health.note("frame", "")

    def drop(self, reason: str) -> None:
        """Count a frame that cannot be used and say why."""
        self._good_in_a_row = 0
        self.context.health.count("dropped_bad_frame")
        self.context.health.note("frame", f"frame dropped: {reason}")


class Replay:
    """Feeds a source's frames to the service when they are due."""

    def __init__(self, service: CameraService, source: Source, config: CameraConfig) -> None:
        self._service = service
        self._source = source
        self._frames: Iterator[RgbdFrame | BadFrame] = iter(source)
        self._config = config
        self._next: RgbdFrame | BadFrame | None = None
        self._done = False
        self._first_ns: int | None = None
        self._begun_ns = 0

    def tick(self) -> None:
        """Send the next frame when its time has come; at most one, so that a stop is never far."""
        if self._done:
            return
        if self._next is None and not self._fetch():
            return
        assert self._next is not None
        if self._source.paced and self._due_ns(self._next.stamp_ns) > self._service.context.clock.now_ns():
            return
        item, self._next = self._next, None
        if isinstance(item, BadFrame):
            self._service.drop(item.reason)
        elif self._source.paced and self._config.restamp:
            self._service.publish(dataclasses.replace(item, stamp_ns=self._due_ns(item.stamp_ns)))
        else:
            self._service.publish(item)

    def _fetch(self) -> bool:
        with self._service.context.health.timed("frame"):
            self._next = next(self._frames, None)
        if self._next is None:
            self._done = True
            self._service.context.health.count("source_done")
            return False
        if self._first_ns is None:
            self._first_ns = self._next.stamp_ns
            self._begun_ns = self._service.context.clock.now_ns()
        return True

    def _due_ns(self, stamp_ns: int) -> int:
        """Return when a frame is due on our clock: recorded intervals, divided by the rate."""
        assert self._first_ns is not None
        return self._begun_ns + round((stamp_ns - self._first_ns) / self._config.rate)
