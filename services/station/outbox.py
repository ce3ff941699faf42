"""What waits for one browser: bounded, so that a slow one costs nothing but itself. Pure.

State is replaced by newer state; what must arrive in order is queued, and a browser that lets that queue run full is
cut off: it comes back by itself and gets everything anew.
"""

from __future__ import annotations

from collections import deque

_QUEUE = 1_024
_QUEUE_BYTES = 8_000_000
_LATEST_BYTES = 64_000_000

Frame = str | bytes


class Outbox:
    """Frames on their way to one browser."""

    def __init__(self) -> None:
        self._queue: deque[Frame] = deque()
        self._queued_bytes = 0
        self._latest: dict[str, Frame] = {}
        self._latest_bytes = 0
        self.replaced = 0
        self.overflowed = False

    def put(self, frame: Frame) -> None:
        """Queue a frame that must arrive."""
        self._queued_bytes += len(frame)
        if len(self._queue) >= _QUEUE or self._queued_bytes > _QUEUE_BYTES:
            self.overflowed = True
            return
        self._queue.append(frame)

    def put_latest(self, key: str, frame: Frame) -> None:
        """Have ``frame`` sent in place of an earlier one of ``key`` that still waits."""
        before = self._latest.pop(key, None)
        if before is not None:
            self.replaced += 1
            self._latest_bytes -= len(before)
        self._latest[key] = frame
        self._latest_bytes += len(frame)
        if self._latest_bytes > _LATEST_BYTES:
            self.overflowed = True

    def take(self) -> Frame | None:
        """Return the next frame, None when nothing waits."""
        if self._queue:
            frame = self._queue.popleft()
            self._queued_bytes -= len(frame)
            return frame
        if self._latest:
            key = next(iter(self._latest))
            frame = self._latest.pop(key)
            self._latest_bytes -= len(frame)
            return frame
        return None
