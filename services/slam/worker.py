"""Who does the mapping: the caller at once (lockstep), or a thread beside tracking (live).

Both run the same jobs. A job touches the map only inside ``step()``, for a millisecond or two; what takes long (bundle
adjustment, pose graph) works on copies between two steps and is applied by the second. Tracking owns the map inside
``frame()`` and goes first: a frame waits for at most one step, and finds the map as it was or as it became, never between.
Frames add keyframes and points; only jobs end or merge them: what a job has copied is still there when it applies it.
"""

from __future__ import annotations

import logging
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from typing import Protocol

from services.common.process import give_way

LOG = logging.getLogger(__name__)

Job = Callable[[], None]

_SWITCH_S = 0.0005
"""How long a thread may keep Python to itself: the default of 5 ms would be added to a frame's time."""
_CLOSE_S = 0.3
_MOST_UNFINISHED = 2
"""Keyframes that may be in the map before the mapping of the first of them is done."""
_PATIENCE_S = 0.6
_NICE = 4
"""Where cores are few tracking runs first (Linux: per thread), but frames may have to wait for mapping (``keep_up``): at 10, with
both cores taken by others, it starved, and they waited up to 0.57 s (at 4 up to 0.26 s, half as many frames left out)."""


class Crew(Protocol):
    """Runs mapping jobs one after another."""

    def frame(self) -> AbstractContextManager[None]:
        """Own the map for one frame."""
        ...

    def step(self) -> AbstractContextManager[None]:
        """Own the map for one short step of a job; free inside a frame or a step of the same thread."""
        ...

    def submit(self, job: Job) -> None:
        """Have a job done, after those submitted before."""
        ...

    @property
    def waiting(self) -> int:
        """Jobs that have not begun."""
        ...

    @property
    def idle(self) -> bool:
        """Whether nothing is being done and nothing waits."""
        ...

    def keep_up(self) -> bool:
        """Wait, for a while, until few jobs are unfinished; return whether there was anything to wait for."""
        ...

    def close(self) -> None:
        """Stop: what waits is forgotten."""
        ...


class Inline:
    """Does each job at once on the caller's thread: the same frames give the same map."""

    waiting = 0
    idle = True

    def frame(self) -> AbstractContextManager[None]:
        """Return nothing to wait for."""
        return nullcontext()

    def step(self) -> AbstractContextManager[None]:
        """Return nothing to wait for."""
        return nullcontext()

    def submit(self, job: Job) -> None:
        """Do the job."""
        job()

    def keep_up(self) -> bool:
        """Return at once: nothing is ever behind."""
        return False

    def close(self) -> None:
        """Nothing runs."""


class Beside:
    """One thread for the jobs. A job's exception is kept and raised by the next ``frame()``: it is a bug, told as one."""

    def __init__(self) -> None:
        sys.setswitchinterval(_SWITCH_S)
        self._turn = threading.Condition()
        self._owner: int | None = None
        self._frame_waits = False
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._fault: BaseException | None = None
        self._unfinished = 0
        self._thread = threading.Thread(target=self._run, name="mapping", daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """Jobs that have not begun."""
        return self._jobs.qsize()

    @property
    def idle(self) -> bool:
        """Whether nothing is being done and nothing waits."""
        return self._unfinished == 0

    @contextmanager
    def frame(self) -> Iterator[None]:
        """Own the map for one frame, before any step that has not begun.

        Raises:
            RuntimeError: a job failed.
        """
        with self._turn:
            if self._fault is not None:
                raise RuntimeError("mapping failed") from self._fault
            self._frame_waits = True
            while self._owner is not None:
                self._turn.wait()
            self._owner, self._frame_waits = threading.get_ident(), False
        try:
            yield
        finally:
            self._leave()

    @contextmanager
    def step(self) -> Iterator[None]:
        """Own the map for one step."""
        me = threading.get_ident()
        if self._owner == me:
            yield
            return
        with self._turn:
            while self._owner is not None or self._frame_waits:
                self._turn.wait()
            self._owner = me
        try:
            yield
        finally:
            self._leave()

    def _leave(self) -> None:
        with self._turn:
            self._owner = None
            self._turn.notify_all()

    def keep_up(self) -> bool:
        """Let mapping catch up before the next frame: keyframes laid on keyframes that nobody has adjusted go astray.

        Where processors are short frames are dropped instead, and after ``_PATIENCE_S`` one is taken all the same: whoever
        flies by the poses must see that they come late.
        """
        with self._turn:
            if self._unfinished <= _MOST_UNFINISHED:
                return False
            self._turn.wait_for(lambda: self._unfinished <= _MOST_UNFINISHED or self._fault is not None, _PATIENCE_S)
            return True

    def submit(self, job: Job) -> None:
        """Queue a job."""
        with self._turn:
            self._unfinished += 1
        self._jobs.put(job)

    def close(self) -> None:
        """Forget what waits and stop; a job that takes long is not waited for: its thread ends with the process."""
        with suppress(queue.Empty):  # the thread may take the last one meanwhile
            while True:
                self._jobs.get_nowait()
        self._jobs.put(None)
        self._thread.join(_CLOSE_S)

    def _run(self) -> None:
        give_way(_NICE)
        while (job := self._jobs.get()) is not None:
            try:
                job()
            except Exception as error:
                LOG.exception("a mapping job failed")
                with self._turn:
                    self._fault = error
                    self._turn.notify_all()
                return
            with self._turn:
                self._unfinished -= 1
                self._turn.notify_all()
