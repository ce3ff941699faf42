"""The camera process: frames from a source to ``camera/rgbd``, at the source's pace."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from schemas.camera import ColourEncoding, RgbdFrame
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SIM_RGBD
from services.camera.codecs import FrameError, recode
from services.camera.conditioning import Conditioner
from services.camera.config import CameraConfig
from services.camera.sources import BadFrame, ConditionedSource, open_source
from services.camera.sources.strays import JUMP_NS
from services.camera.warm import warm
from services.camera.watch import StreamWatch
from services.common.clock import on_clock_ns
from services.common.context import Context

_TICK_S = 0.005
_SILENCE_TICK_S = 0.1
_KEPT_NOTE_FRAMES = 30
"""A bad frame is told in health until this many good ones came after it."""


def build(context: Context) -> CameraService:
    """Open the configured source and register the work.

    Raises:
        InputError: the source cannot be opened.
    """
    config: CameraConfig = context.config.camera
    warm()
    service = CameraService(context, config)
    if config.source == "sim":
        simulated = Simulated(service, config)
        context.on(SIM_RGBD, simulated.on_frame)
    else:
        replay = Replay(service, open_source(config.source, config), config)
        context.every(_TICK_S, replay.tick)
        context.every(_SILENCE_TICK_S, replay.on_silence)
    return service


class CameraService:
    """Publishes good frames, counts and tells the bad ones."""

    def __init__(self, context: Context, config: CameraConfig) -> None:
        self.context = context
        self._config = config
        self._good_in_a_row = 0

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

    def tell_stream(self, counts: dict[str, int], note: str) -> None:
        """Put what the watch found into health."""
        self.context.health.counters.update(counts)
        self.context.health.note("source", note)


class Simulated:
    """Passes on the simulated sensor's frames through the same watch and depth pipeline as a real one's."""

    def __init__(self, service: CameraService, config: CameraConfig) -> None:
        self._service = service
        self._conditioner = Conditioner(config)
        self._watch = StreamWatch(stall_s=config.stall_s)

    def on_frame(self, frame: RgbdFrame) -> None:
        """Condition and publish one frame."""
        health = self._service.context.health
        try:
            with health.timed("frame"):
                conditioned = self._conditioner.apply(frame)
        except FrameError as error:
            self._service.drop(str(error))
            return
        for stage, ms in self._conditioner.stage_ms.items():
            health.stage_ms[stage].append(ms)
        self._watch.see(conditioned.stamp_ns)
        self._service.tell_stream(self._watch.counts(), self._watch.note())
        self._service.publish(conditioned)


class Replay:
    """Feeds a source's frames to the service when they are due."""

    def __init__(self, service: CameraService, source: ConditionedSource, config: CameraConfig) -> None:
        self._service = service
        self._source = source
        self._frames: Iterator[RgbdFrame | BadFrame] = iter(source)
        self._config = config
        self._next: RgbdFrame | BadFrame | None = None
        self._done = False
        self._first_ns: int | None = None
        self._before_ns = self._begun_ns = 0
        self._last_ns: int | None = None

    def tick(self) -> None:
        """Send the next frame when its time has come; at most one, so that a stop is never far."""
        if self._done:
            return
        if self._next is None and not self._fetch():
            return
        assert self._next is not None
        waits = self._source.paced and isinstance(self._next, RgbdFrame)  # a bad frame's stamp says nothing
        if waits and self._due_ns(self._next.stamp_ns) > self._service.context.clock.now_ns():
            return
        item, self._next = self._next, None
        if isinstance(item, BadFrame):
            self._service.drop(item.reason)
        elif self._frozen():
            self._service.drop(
                f"the camera has sent one and the same picture {self._source.watch.repeated_in_a_row} times"
            )
        elif not self._source.paced:
            # a sensor's stamps are the machine's, whose clock somebody may set while we fly
            self._service.publish(
                dataclasses.replace(item, stamp_ns=on_clock_ns(self._service.context.clock, item.stamp_ns))
            )
        elif self._config.restamp:
            self._service.publish(dataclasses.replace(item, stamp_ns=self._due_ns(item.stamp_ns)))
        else:
            self._service.publish(item)

    def on_silence(self) -> None:
        """Tell a sensor that stopped sending."""
        if self._done or self._source.paced or self._last_ns is None:
            return
        watch, now_ns = self._source.watch, self._service.context.clock.now_ns()
        if watch.silence((now_ns - self._last_ns) / 1e9):
            self._service.tell_stream(watch.counts(), watch.note())

    def _frozen(self) -> bool:
        """Return whether a sensor repeats itself: it is then as good as dead, and the failsafe for that must see it."""
        watch = self._source.watch
        period_s = watch.period_s
        repeated_s = watch.repeated_in_a_row * (period_s or 0.0)
        return not self._source.paced and repeated_s > watch.stall_s

    def _fetch(self) -> bool:
        health = self._service.context.health
        with health.timed("frame"):
            self._next = next(self._frames, None)
        for stage, durations in self._source.stage_ms.items():
            health.stage_ms[stage] += durations
            durations.clear()
        self._service.tell_stream(self._source.watch.counts(), self._source.note())
        if isinstance(self._next, RgbdFrame):
            self._last_ns = self._service.context.clock.now_ns()
        if self._next is None:
            self._done = True
            self._service.context.health.count("source_done")
            return False
        if isinstance(self._next, RgbdFrame):
            self._keep_pace(self._next.stamp_ns)
        return True

    def _keep_pace(self, stamp_ns: int) -> None:
        """Begin to count anew at the first frame, and after a pause: that is not waited out."""
        if self._first_ns is None or stamp_ns - self._before_ns > JUMP_NS:
            self._first_ns, self._begun_ns = stamp_ns, self._service.context.clock.now_ns()
        self._before_ns = stamp_ns

    def _due_ns(self, stamp_ns: int) -> int:
        """Return when a frame is due on our clock: recorded intervals, divided by the rate."""
        assert self._first_ns is not None
        return self._begun_ns + round((stamp_ns - self._first_ns) / self._config.rate)
