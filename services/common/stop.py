"""The stop signals, heard even while the work loop is inside a long call, and the sure end of the process."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType

LOG = logging.getLogger(__name__)

_FORCED_AFTER_S = 0.9


class StopSignal:
    """Set by SIGTERM and SIGINT (once installed), or by hand.

    The interpreter only runs Python signal handlers between two bytecodes of the main thread; the wake-up pipe is
    written at once, so that a thread of ours can end the process in time although a long call never returns.
    """

    def __init__(self) -> None:
        self._event = threading.Event()
        self._on_set: list[Callable[[], None]] = []
        self.received: signal.Signals | None = None

    @property
    def is_set(self) -> bool:
        """Whether it is time to stop."""
        return self._event.is_set()

    def when_set(self, action: Callable[[], None]) -> None:
        """Call ``action`` (quick, from any thread) when the stop comes."""
        self._on_set.append(action)

    def set(self) -> None:
        """Ask for the stop."""
        self._event.set()
        for action in self._on_set:
            action()

    def wait(self, timeout_s: float) -> bool:
        """Sleep until the stop or for ``timeout_s``; return whether it is time to stop."""
        return self._event.wait(timeout_s)

    def install(self, force: bool = True) -> None:
        """Take over SIGTERM and SIGINT (main thread only); ``force`` ends the process 0.9 s later in any case."""
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, _ignored)
        threading.Thread(target=self._listen, args=(reader, force), name="stop-signal", daemon=True).start()

    def _listen(self, reader: int, force: bool) -> None:
        while data := os.read(reader, 1):
            if data[0] not in {signal.SIGTERM, signal.SIGINT}:
                continue
            self.received = signal.Signals(data[0])
            self.set()
            if force:
                threading.Event().wait(_FORCED_AFTER_S)
                LOG.warning("still busy %.1f s after the stop signal: ending without a clean close", _FORCED_AFTER_S)
                end_process(0)


def _ignored(number: int, frame: FrameType | None) -> None:
    """Stand in as handler: the pipe already told the thread."""
    del number, frame


def end_process(code: int) -> None:
    """End this process now, with its streams flushed and nothing else run: no library can hang it any more."""
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # a closed pipe or stream has nothing left to flush
            continue
    os._exit(code)
