"""Who has answered the frame that is out: simulated time stands still until all have, or their time is up."""

from __future__ import annotations


class Lockstep:
    """Keeps account of one frame at a time. Times are seconds of any clock that the caller reads."""

    def __init__(self, services: tuple[str, ...], timeout_s: float) -> None:
        self._services = services
        self._timeout_s = timeout_s
        self._stamp_ns: int | None = None
        self._sent_s = 0.0
        self._missing: set[str] = set()

    def sent(self, stamp_ns: int, now_s: float) -> None:
        """Begin to wait for the answers to a frame."""
        self._stamp_ns, self._sent_s, self._missing = stamp_ns, now_s, set(self._services)

    def answered(self, service: str, stamp_ns: int) -> bool:
        """Take an answer; true when it was the last one missing. Answers to older frames count for nothing."""
        if stamp_ns != self._stamp_ns or service not in self._missing:
            return False
        self._missing.discard(service)
        return not self._missing

    def waited_s(self, now_s: float) -> float:
        """Return how long the frame has been out."""
        return now_s - self._sent_s

    def overdue(self, now_s: float) -> tuple[str, ...]:
        """Return who has let the time limit pass, in order of registration; empty while there is time."""
        if self._stamp_ns is None or self.waited_s(now_s) < self._timeout_s:
            return ()
        return tuple(service for service in self._services if service in self._missing)
