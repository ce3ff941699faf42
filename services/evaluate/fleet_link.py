"""An arbiter behind a link that delays, loses, repeats and reorders, in anybody's time: for tests and the fleet bench."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field

from schemas.fleet import ClaimGoal, ClaimReply
from services.fleet.book import Book, Memory
from services.fleet.config import FleetConfig
from services.fleet.holder import Asked
from services.fleet.shapes import Stretch

Place = Callable[[str, ClaimGoal], Stretch | str]
Take = Callable[[Asked, list[ClaimReply]], None]


@dataclass(frozen=True, slots=True)
class Clock:
    """Runs at ``rate`` times true time, from a zero of its own."""

    rate: float
    zero_ns: int = 0

    def at(self, true_ns: int) -> int:
        """Return what it shows."""
        return self.zero_ns + round(true_ns * self.rate)


@dataclass(frozen=True, slots=True)
class LinkFaults:
    """How bad the link is."""

    loss: float = 0.1
    delay_ns: int = 500_000_000
    """The longest of most messages; one in ten may take ``straggle`` times as long."""
    straggle: int = 5
    repeat: float = 0.1


@dataclass
class FleetLink:
    """Messages on their way in true time, and the arbiter at the other end."""

    rules: FleetConfig
    faults: LinkFaults
    rng: random.Random
    clock: Clock
    """The arbiter's."""
    place: Place
    disk: Memory | None = None
    """What outlives the arbiter."""
    cut: set[str] = field(default_factory=set)
    """Aircraft that no message reaches or leaves."""
    alive: bool = False
    _requests: list[tuple[int, str, Asked, Take]] = field(default_factory=list)
    _replies: list[tuple[int, str, Asked, Take, ClaimReply]] = field(default_factory=list)

    def start_arbiter(self, now_ns: int) -> None:
        """Begin a new arbiter with what is on the disk."""
        self.book = Book(self.rules, "arbiter", self._remember)
        self.book.begin(self.disk, self.clock.at(now_ns))
        self.alive = True

    def _remember(self, memory: Memory) -> None:
        self.disk = memory

    def send(self, uav: str, asked: Asked, take: Take, now_ns: int) -> None:
        """Put a question on its way; ``take`` is called with the answer, should one arrive."""
        self._requests += [(now_ns + delay, uav, asked, take) for delay in self._delays(uav)]

    def step(self, now_ns: int) -> None:
        """Deliver what is due."""
        due = [m for m in self._requests if m[0] <= now_ns]
        self._requests = [m for m in self._requests if m[0] > now_ns]
        for _, uav, asked, take in due:
            if self.alive:
                way = self.place(uav, asked.request.goal)
                reply = self.book.answer(uav, asked.request, way, self.clock.at(now_ns))
                self._replies += [(now_ns + delay, uav, asked, take, reply) for delay in self._delays(uav)]
        arrived = [m for m in self._replies if m[0] <= now_ns]
        self._replies = [m for m in self._replies if m[0] > now_ns]
        for _, uav, asked, take, reply in arrived:
            if uav not in self.cut:
                take(asked, [reply])

    def _delays(self, uav: str) -> list[int]:
        """Return none for a message that is lost, two for one that is repeated."""
        f = self.faults
        if uav in self.cut or self.rng.random() < f.loss:
            return []
        longest = f.delay_ns * (f.straggle if self.rng.random() < 0.1 else 1)
        return [self.rng.randrange(longest + 1) for _ in range(2 if self.rng.random() < f.repeat else 1)]
