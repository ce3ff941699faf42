"""The simulated autopilot in wall time, for clients that have their own clock (ground stations, mavsdk)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Self

_WAKE_S = 0.002
_MOST_BEHIND_S = 0.25


class RealTimeRunner:
    """Calls ``step(dt_s)`` from a thread so that simulated time follows the wall's, ``speed`` times as fast.

    A machine that cannot keep up makes simulated time slower, never coarser. Use as a context manager; an exception of
    ``step`` ends the thread and is raised again on leaving.
    """

    def __init__(self, step: Callable[[float], None], tick_s: float, speed: float = 1.0) -> None:
        self._step, self._tick_s, self._speed = step, tick_s, speed
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="px4-runner", daemon=True)
        self._error: BaseException | None = None
        self.late_s = 0.0
        """Wall time given up so far because the machine was too slow."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """End the thread and wait for it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        due_s = time.monotonic()
        try:
            while not self._stop.is_set():
                behind_s = time.monotonic() - due_s
                if behind_s > _MOST_BEHIND_S:
                    self.late_s += behind_s
                    due_s += behind_s
                if behind_s < 0.0:
                    self._stop.wait(max(_WAKE_S, -behind_s))
                    continue
                self._step(self._tick_s)
                due_s += self._tick_s / self._speed
        except BaseException as error:  # noqa: BLE001  # handed to the owner, who raises it
            self._error = error
