"""Plays a recording onto the bus: each message when it is due, stamps moved to now."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.camera import RgbdFrame
from schemas.codec import Wire
from schemas.topics import ANY, CAMERA_COMPRESSED, CAMERA_RGBD, TOPICS, VEHICLE_STATE, Topic
from services.common.errors import InputError
from services.doctor.twins import SINGLE
from services.recorder.index import summary
from services.recorder.reader import Recorded, messages
from services.security.access import may_publish

if TYPE_CHECKING:
    from services.common.bus import Bus
    from services.common.config import TreedockConfig
    from services.common.stop import StopSignal

SENSORS: tuple[Topic, ...] = (CAMERA_RGBD, CAMERA_COMPRESSED, VEHICLE_STATE)
"""What services are fed with; all else they make themselves."""
_SPEAKER = "camera"
"""Whose certificate a replay shows."""


@dataclass(frozen=True, slots=True)
class Span:
    """Which part, and how fast."""

    begin_s: float = 0.0
    end_s: float | None = None
    rate: float = 1.0


@dataclass(slots=True)
class Played:
    """What a replay did."""

    sent: int = 0
    seconds: float = 0.0
    length_s: float = 0.0
    """From the recording's first message of those topics to its end, as far as it is known."""
    faults: list[str] = field(default_factory=list)
    denied: Counter[str] = field(default_factory=Counter)
    """Messages by topic that an encrypted bus would not have taken from a camera, and that were not sent."""


def check(span: Span) -> None:
    """Refuse a span that holds nothing.

    Raises:
        InputError: it ends before it begins.
    """
    if span.end_s is not None and span.end_s <= span.begin_s:
        raise InputError(f"--to {span.end_s:g} s is not after --from {span.begin_s:g} s")


def play(config: TreedockConfig, file: Path, span: Span, *, everything: bool = False) -> Played:
    """Play a file onto the configured bus until its end or a stop signal.

    Raises:
        InputError: the file cannot be used, no router answers, or those run whose words it would say.
    """
    from services.common.bus import Bus
    from services.common.context import HealthBook
    from services.common.session import opened_node
    from services.common.stop import StopSignal

    stop = StopSignal()
    stop.install()
    topics = TOPICS if everything else SENSORS
    first = next((entry for entry in messages(file, topics) if isinstance(entry, Recorded)), None)
    if first is None:
        raise InputError(f"{file}: it holds nothing to replay; `treedock recordings` shows what is in a file")
    _refuse_beyond(file, span, _length_s(file, first.stamp_ns))
    with opened_node(config, _SPEAKER, lambda: stop.is_set, wait_s=0.0) as session:
        bus = Bus(session, config.uav, HealthBook())
        others = SINGLE if everything else frozenset(topic.producer for topic in SENSORS)
        alone(bus, others)
        encrypted = config.security.folder is not None
        return play_on(bus, file, messages(file, topics), span, stop, others, encrypted=encrypted)


def alone(bus: Bus, others: Iterable[str]) -> None:
    """Refuse to speak beside those whose words a recording holds: a recorded flight's guidance would fly the aircraft.

    Raises:
        InputError: some of them run.
    """
    live = sorted(name for name in others if bus.alive(name))
    if live:
        raise InputError(
            f"replay: {', '.join(live)} of {bus.uav} would be mixed up with the recording: stop what runs first, for "
            "example sudo systemctl stop treedock.target"
        )


def _length_s(file: Path, first_ns: int) -> float | None:
    """Return how long after ``first_ns`` a recording ends; None where only reading it through would tell."""
    try:
        run = summary(file)
    except InputError:
        return None  # damaged, and played as far as it goes
    return 1e-9 * (run.begun_ns - first_ns) + run.seconds if run.counts else None


def _refuse_beyond(file: Path, span: Span, length_s: float | None) -> None:
    if length_s is not None and span.begin_s > length_s:
        raise InputError(f"--from {span.begin_s:g} s: {file.name} is only {length_s:.1f} s long")


def _may_say(entry: Recorded) -> bool:
    """Whether an encrypted bus takes this from a camera; the router drops all else without a word."""
    return may_publish(_SPEAKER, entry.topic) and (entry.topic.producer != ANY or entry.leaf == _SPEAKER)


def play_on(
    bus: Bus, file: Path, entries: Iterable[Recorded | str], span: Span, stop: StopSignal, others: Iterable[str], *,
    encrypted: bool = False,
) -> Played:  # fmt: skip
    """Play what ``file`` holds, ``entries``, onto the bus; where that is ``encrypted``, what a camera may say.

    Raises:
        InputError: the file ends before the span begins, or one of ``others`` was started.
    """
    played, begin_s = Played(), time.monotonic()
    first_ns, moved_ns = None, 0
    for entry in entries:
        if isinstance(entry, str):
            played.faults.append(entry)
            continue
        if first_ns is None:
            first_ns, begin_s = entry.stamp_ns, time.monotonic()
            # the moment of now at which the recording's start would lie: added to every stamp of the recording
            moved_ns = time.time_ns() - first_ns - round(span.begin_s * 1e9)
            played.length_s = _length_s(file, first_ns) or 0.0
        at_s = 1e-9 * (entry.stamp_ns - first_ns)
        played.length_s = max(played.length_s, at_s)
        if at_s < span.begin_s:
            continue
        if stop.is_set or (span.end_s is not None and at_s > span.end_s):
            break
        if encrypted and not _may_say(entry):
            played.denied[entry.topic.name] += 1
            continue
        due_s = begin_s + (at_s - span.begin_s) / span.rate
        if (wait_s := due_s - time.monotonic()) > 0 and stop.wait(wait_s):
            break
        alone(bus, others)  # one of them may have been started since
        topic, message = _to_send(entry, moved_ns, at_s - span.begin_s, span.rate)
        bus.publish(topic, message, entry.leaf)
        played.sent += 1
    if not stop.is_set:
        _refuse_beyond(file, span, played.length_s)
    played.seconds = time.monotonic() - begin_s
    return played


def _to_send(entry: Recorded, moved_ns: int, into_s: float, rate: float) -> tuple[Topic, Wire]:
    """Return the topic and the message with its stamp in the present: old stamps would count as stale data."""
    # faster or slower, the stamps keep the recorded intervals' ratio to the wall clock
    shift_ns = moved_ns + round(into_s * 1e9 * (1.0 / rate - 1.0))
    message = entry.message
    if isinstance(message, RgbdFrame):
        from services.camera.codecs import raw

        message = raw(dataclasses.replace(message, stamp_ns=message.stamp_ns + shift_ns))
        return CAMERA_RGBD, message
    stamp_ns = getattr(message, "stamp_ns", None)
    if isinstance(stamp_ns, int) and hasattr(message, "model_copy"):
        message = message.model_copy(update={"stamp_ns": stamp_ns + shift_ns})
    return entry.topic, message
