"""The health message, made from the book that a service keeps."""

from __future__ import annotations

import math
import os
import re
import statistics
import time
from collections.abc import Mapping
from typing import Literal, TypeVar

from schemas.envelope import MAX_TEXT
from schemas.health import Health
from schemas.topics import HEALTH
from services.common.context import HealthBook
from services.common.version import running_version

State = Literal["starting", "ready", "degraded", "stopping"]

V = TypeVar("V")

_UNFIT = re.compile(r"[^A-Za-z0-9_.:/*-]")
_MAX_COUNTERS = 128
_MAX_RATES = 64


class HealthReporter:
    """Makes one health message per call; rates and stage times are those since the call before."""

    def __init__(self, service: str, book: HealthBook) -> None:
        self._service = service
        self._book = book
        self._begin_s = time.monotonic()
        self._since_s = self._begin_s
        self._passed: dict[str, int] = {}
        self._seq = 0

    def report(self, stamp_ns: int, passed: Mapping[str, int], state: State | None = None, waiting: str = "") -> Health:
        """Return the health now.

        Args:
            stamp_ns: the time of the report.
            passed: samples sent and received per topic since the start.
            state: None: ``ready``, or ``degraded`` while the book holds a note.
            waiting: what the service has not heard of yet; told, but no fault.
        """
        now_s = time.monotonic()
        elapsed_s = max(now_s - self._since_s, 1e-3)
        rates = {name: (count - self._passed.get(name, 0)) / elapsed_s for name, count in passed.items()}
        rates.pop(HEALTH.name, None)
        self._since_s, self._passed = now_s, dict(passed)
        notes = [f"{about}: {text}" for about, text in sorted(self._book.notes.items())]
        health = Health(
            service=self._service,
            stamp_ns=stamp_ns,
            seq=self._seq,
            state=state or ("degraded" if notes else "ready"),
            pid=os.getpid(),
            uptime_s=now_s - self._begin_s,
            counters=_labelled({name: max(0, int(n)) for name, n in self._book.counters.items()}, _MAX_COUNTERS),
            rates_hz=_labelled({name: round(rate, 2) for name, rate in rates.items()}, _MAX_RATES),
            work_ms=_labelled(self._medians_ms(), _MAX_RATES),
            note="; ".join(notes + [waiting] * bool(waiting))[:MAX_TEXT],
            version=running_version(),
        )
        self._seq += 1
        return health

    def _medians_ms(self) -> dict[str, float]:
        medians = {stage: statistics.median(times) for stage, times in self._book.stage_ms.items() if times}
        self._book.stage_ms.clear()
        return {stage: round(ms, 3) for stage, ms in medians.items() if math.isfinite(ms)}


def _labelled(values: dict[str, V], most: int) -> dict[str, V]:
    """Return the entries under names that the message accepts: a service's free naming must never fail its health."""
    fit = {_UNFIT.sub("_", name)[:96] or "_": value for name, value in values.items()}
    return dict(sorted(fit.items())[:most])
