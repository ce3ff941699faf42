"""The recorder as a process: everything that the topics table marks as recorded, into MCAP files."""

from __future__ import annotations

import datetime as dt
import logging
from functools import partial
from importlib.metadata import version

from schemas.camera import RgbdFrame
from schemas.codec import Wire, encode
from schemas.health import Health
from schemas.topics import (
    CAMERA_COMPRESSED,
    CAMERA_RGBD,
    HEALTH,
    MAP_CLOUD,
    MISSION_STATE,
    SLAM_POSE,
    TOPICS,
    TREES_LIST,
    TREES_TARGET,
    Delivery,
    Topic,
)
from services.common.context import Context
from services.common.errors import InputError
from services.common.files import make_folder, write_whole
from services.recorder.chronicle import Chronicle
from services.recorder.config import RecorderConfig
from services.recorder.drain import Drain, Entry, Limits
from services.recorder.foxglove import Translator, warm
from services.recorder.mcap_file import McapFile
from services.recorder.mender import Mender
from services.recorder.space import free_bytes, tell_space

LOG = logging.getLogger(__name__)

_MB = 1_000_000
_TELL_S = 1.0
_RING = 64
"""Of every topic: a recorder keeps what came while it was busy, where others want the newest only."""


def build(context: Context) -> RecorderService:
    """Open a file, register the work, and have what an earlier recorder left cut mended beside it.

    Raises:
        InputError: the folder cannot be written.
    """
    config = context.config.recorder
    make_folder(config.folder)
    warm()
    service = RecorderService(context, config)
    for topic in recorded_topics(config):
        leaf = "*" if topic.name.endswith("*") else None
        context.on(topic, partial(service.take, topic), leaf, ring=_RING)
    context.every_wall(_TELL_S, service.tell)
    context.on_stop(service.stop)
    return service


def recorded_topics(config: RecorderConfig) -> list[Topic]:
    """Return what goes into the file, or what a report is made from."""
    if not config.mcap:
        return [SLAM_POSE, MAP_CLOUD, TREES_LIST, TREES_TARGET, MISSION_STATE, HEALTH]
    frames = {"compressed": CAMERA_COMPRESSED, "raw": CAMERA_RGBD}.get(config.frames)
    left_out = {CAMERA_RGBD, CAMERA_COMPRESSED} - {frames}
    return [t for t in TOPICS if t.recorded and t.delivery is not Delivery.QUERY and t not in left_out]


class RecorderService:
    """Encodes messages and hands them to the drain; the disk is the drain's."""

    def __init__(self, context: Context, config: RecorderConfig) -> None:
        self._context = context
        self._config = config
        self._files = 0
        self._translator = Translator(context.uav, config.foxglove_image_hz) if config.foxglove else None
        limits = Limits(config.flush_s, config.file_mb * _MB, config.queue_mb * _MB, config.reserve_mb * _MB)
        self._begun = dt.datetime.now(dt.UTC)
        self.drain = Drain(self._open_file, limits, lambda: free_bytes(config.folder)) if config.mcap else None
        self._mender = Mender(config.folder, config.reserve_mb) if config.mcap else None
        self._told: dict[str, int] = {}
        self._chronicle = Chronicle(context.uav)
        self._reports = 0

    def take(self, topic: Topic, message: Wire) -> None:
        """Queue one message, and what Foxglove shows of it; write the report when a mission has ended with it."""
        with self._context.health.timed("take"):
            if self.drain is not None:
                self._queue(self.drain, topic, message)
            ended = not topic.beside and self._chronicle.hear(message)
        if ended:
            self._report()

    def _queue(self, drain: Drain, topic: Topic, message: Wire) -> None:
        stamp_ns = self._context.clock.now_ns()
        heavy = isinstance(message, RgbdFrame)
        key = topic.key(self._context.uav, message.service if isinstance(message, Health) else None)
        schema, seq = getattr(topic.message, "SCHEMA", topic.name), getattr(message, "seq", 0)
        drain.put(Entry(key, schema, topic.encoding, bytes(encode(message)), stamp_ns, seq, heavy))
        if self._translator is not None and not topic.beside:
            for name, shown in self._translator.translate(message):
                drain.put(Entry(name, "", "", shown, stamp_ns, 0, heavy))

    def tell(self) -> None:
        """Bring the drain's counters and its trouble into health."""
        if self.drain is None:
            return
        health = self._context.health
        if self._mender is not None:
            self._mender.look(health)
        for name, value in sorted(self.drain.counters.items()):
            health.count(name, value - self._told.get(name, 0))
            self._told[name] = value
        health.note("disk", self.drain.trouble)
        tell_space(health, self._config.folder, self._config.reserve_mb)

    def stop(self) -> None:
        """Complete the file; tell of a mission that had not ended."""
        if self._mender is not None:
            self._mender.stop()
        if self._chronicle.owed:
            self._report()
        if self.drain is not None:
            self.drain.close()

    def _report(self) -> None:
        """Write the mission's report.html beside the recording; a disk that refuses costs the report alone."""
        from services.evaluate.mission_report import mission_report

        self._reports += 1
        path = self._config.folder / f"{self._context.uav}-{self._begun:%Y%m%dT%H%M%SZ}-report-{self._reports:02d}.html"
        try:
            with self._context.health.timed("report"):
                write_whole(path, mission_report(self._chronicle.story()))
        except InputError as error:
            self._context.health.note("report", str(error))
            return
        self._chronicle.reported = True
        LOG.info("report: %s", path)

    def _open_file(self) -> McapFile:
        for _ in range(1000):
            self._files += 1
            name = f"{self._context.uav}-{self._begun:%Y%m%dT%H%M%SZ}-{self._files:03d}.mcap"
            path = self._config.folder / name
            if not path.exists():
                LOG.info("recording to %s", path)
                return McapFile(path, self._about())
        raise InputError(f"{self._config.folder}: holds a thousand files of this very second; empty it")

    def _about(self) -> dict[str, str]:
        return {
            "uav": self._context.uav,
            "version": version("treedock"),
            "begun_utc": f"{self._begun:%Y-%m-%dT%H:%M:%SZ}",
            "config": self._context.config.model_dump_json(),
        }
