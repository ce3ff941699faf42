"""Questions to the bus that nobody waits for: asked on threads of their own, answered through the inbox."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import zenoh

from schemas.codec import Wire
from schemas.topics import Topic
from services.common.bus import Bus
from services.common.inbox import Inbox
from services.common.logging import Throttle

LOG = logging.getLogger(__name__)

A = TypeVar("A", bound=Wire)

_AT_ONCE = 4
_WAITING = 64


class Asking:
    """A few threads that ask; an answer, or its absence, is an item of the work loop like any other."""

    def __init__(self, bus: Bus, inbox: Inbox) -> None:
        self._bus = bus
        self._inbox = inbox
        self._box = inbox.mailbox(lambda call: call(), _WAITING)
        self._pool = ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="ask")
        self._throttle = Throttle()

    def ask(
        self, topic: Topic, request: Wire, kind: type[A], timeout_s: float, then: Callable[[list[A]], None]
    ) -> None:
        """Ask, and have the work loop call ``then`` with what came."""

        def work() -> None:
            replies: list[A] = []
            try:
                replies = self._bus.ask(topic, request, kind, timeout_s)
            except zenoh.ZError as error:  # the session is closing, or the router away
                self._throttle.log(LOG, logging.WARNING, topic.name, f"{topic.name} could not be asked: {error}")
            except Exception as error:  # noqa: BLE001 - a bug, and no one looks at this thread: the work loop ends with it
                self._inbox.put(self._box, functools.partial(_fail, error))
                return
            self._inbox.put(self._box, lambda: then(replies))

        self._pool.submit(work)

    def close(self) -> None:
        """Ask nothing more."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _fail(error: Exception) -> None:
    raise error
