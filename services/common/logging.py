"""Logging to stderr, one line per record, and a way to say a repeated thing once a second."""

from __future__ import annotations

import logging
import sys
import time


class _OneLine(logging.Formatter):
    """A record on one line; only a traceback, which a person must read, keeps its own lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the message part, without line breaks."""
        return super().formatMessage(record).replace("\r", " ").replace("\n", " | ")


def set_up(service: str, level: str = "info") -> None:
    """Send all records of ``level`` and above to stderr; calling it again replaces the earlier set-up."""
    handler = logging.StreamHandler(sys.stderr)
    form = f"%(asctime)s.%(msecs)03d {service} %(levelname)s %(message)s"
    handler.setFormatter(_OneLine(form, datefmt="%H:%M:%S"))
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())
    logging.getLogger("numba").setLevel(logging.WARNING)  # its debug records are thousands of lines
    logging.captureWarnings(capture=True)


class Throttle:
    """Lets a repeated record through once per period and says how many it held back."""

    def __init__(self, period_s: float = 1.0) -> None:
        self._period_s = period_s
        self._last_s: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def log(self, logger: logging.Logger, level: int, about: str, text: str) -> None:
        """Log ``text`` unless something about ``about`` was logged within the period."""
        now_s = time.monotonic()
        if now_s - self._last_s.get(about, float("-inf")) < self._period_s:
            self._held[about] = self._held.get(about, 0) + 1
            return
        self._last_s[about] = now_s
        held = self._held.pop(about, 0)
        logger.log(level, "%s%s", text, f" (and {held} more like it)" if held else "")
