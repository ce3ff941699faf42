"""Whom simulated time waits for: services that live and answer; never for the dead, and for the hung only so long.

Pure: what is alive is told by the caller, times are seconds of any clock the caller reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass


@dataclass
class Follower:
    """One service that answers simulated time with stamps of its own messages."""

    name: str
    needs: tuple[str, ...] = ()
    """Services without which it cannot answer."""
    answered_ns: int = -1
    joined: bool = False
    """It has answered since it came to life: only then is it waited for."""
    hung: bool = False
    """It let the limit pass and has not answered since."""
    blocked_since_s: float | None = None


class Followers:
    """Keeps account of all of them. ``alive(name)`` tells of their lives."""

    def __init__(self, followers: Iterable[Follower], alive: Callable[[str], bool], hung_after_s: float) -> None:
        self._followers = {follower.name: follower for follower in followers}
        self._alive = alive
        self._hung_after_s = hung_after_s
        self.timeouts = 0

    def answered(self, name: str, stamp_ns: int) -> None:
        """Take note of an answer; a hung one is waited for again."""
        follower = self._followers[name]
        follower.answered_ns = max(follower.answered_ns, stamp_ns)
        follower.joined = True
        follower.hung = False
        follower.blocked_since_s = None

    def waits(self, names: Iterable[str], stamp_ns: int, now_s: float) -> bool:
        """Return whether time must stand still until each of ``names`` has said something of ``stamp_ns`` or later."""
        waiting = False
        for name in names:
            follower = self._followers[name]
            if follower.answered_ns >= stamp_ns or not self._counts(follower):
                follower.blocked_since_s = None
                continue
            if follower.blocked_since_s is None:
                follower.blocked_since_s = now_s
            if now_s - follower.blocked_since_s >= self._hung_after_s:
                follower.hung = True
                follower.blocked_since_s = None
                self.timeouts += 1
            else:
                waiting = True
        return waiting

    @property
    def missing(self) -> tuple[str, ...]:
        """Who is dead, hung or has not spoken yet."""
        return tuple(f.name for f in self._followers.values() if not self._counts(f))

    @property
    def hung(self) -> tuple[str, ...]:
        """Who lives but let the limit pass."""
        return tuple(f.name for f in self._followers.values() if f.hung)

    @property
    def complete(self) -> bool:
        """Whether every one is there."""
        return not self.missing

    def _counts(self, follower: Follower) -> bool:
        if not self._alive(follower.name):
            follower.joined = follower.hung = False
            return False
        if any(not self._alive(name) or self._hung(name) for name in follower.needs):
            return False
        return follower.joined and not follower.hung

    def _hung(self, name: str) -> bool:
        return name in self._followers and self._followers[name].hung
