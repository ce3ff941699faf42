"""The arbiter in the station: answers the claims of all aircraft from its book, and tells who holds what."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any

from schemas.fleet import ClaimReply, ClaimRequest
from schemas.topics import FLEET_CLAIM
from services.common.bus import Bus
from services.common.context import HealthBook
from services.fleet.book import Book
from services.fleet.config import FleetConfig
from services.fleet.journal import Journal, book_path
from services.fleet.placing import SharedFrame
from services.inventory.config import InventoryConfig
from services.inventory.values import Laid
from services.station.aircraft import Aircraft
from services.station.events import EventLevel, EventLog

LOG = logging.getLogger(__name__)

LaidMaps = Callable[[], dict[tuple[str, str], Laid]]


class Claims:
    """The book with its file, the shared frame, and the log of what is granted and refused."""

    def __init__(
        self, config: FleetConfig, inventory: InventoryConfig, log: EventLog, health: HealthBook, laid: LaidMaps,
        steady_ns: Callable[[], int],
    ) -> None:  # fmt: skip
        """Open the book.

        Raises:
            InputError: another arbiter keeps it, or its folder cannot be written.
        """
        points = inventory.start_points
        origin = (points[0].latitude_deg, points[0].longitude_deg, points[0].altitude_m) if points else None
        self._journal = Journal(book_path(config), origin)
        self._frame = SharedFrame(self._journal.origin_deg, inventory.start_of)
        self._log, self._health, self._laid, self._steady_ns = log, health, laid, steady_ns
        self.book = Book(config, self._journal.name, self._journal.write)
        self.book.begin(self._journal.memory, steady_ns())
        self._told: dict[str, str] = {}
        """By aircraft, the last refusal that the log holds: the same one again is no news."""

    def attach(self, aircraft: Aircraft, bus: Bus) -> None:
        """Answer an aircraft's claims."""
        bus.answer(FLEET_CLAIM, ClaimRequest, functools.partial(self._on_claim, aircraft))

    def _on_claim(self, aircraft: Aircraft, request: ClaimRequest) -> ClaimReply:
        goal, uav = request.goal, aircraft.uav
        in_air = aircraft.map_begun_in_air and aircraft.trail_map == goal.map_id
        way = self._frame.place(uav, goal, self._laid().get((uav, goal.map_id)), in_air=in_air)
        known = (uav, request.lease_id) in self.book.leases
        reply = self.book.answer(uav, request, way, self._steady_ns())
        self._health.count(f"claims_{'granted' if reply.granted else 'refused'}")
        self._tell(uav, request, reply, known=known)
        return reply

    def _tell(self, uav: str, request: ClaimRequest, reply: ClaimReply, *, known: bool) -> None:
        """Write what changed into the log: grants and releases once, a refusal when its reason is another."""
        goal = request.goal
        what = (
            f"tree {goal.tree_id}" if goal.kind == "tree" else {"place": "its place", "way": "its way home"}[goal.kind]
        )
        level: EventLevel = "info"
        if not reply.granted:
            words, level = f"claim on {what} refused: {reply.reason}", "warn"
        elif request.kind == "done":
            words, level = f"{what} is done", "good"
        elif request.kind == "claim" and not known:
            words = f"claim on {what} granted for {reply.lease_s:.0f} s"
        elif request.kind == "release" and known:
            words = f"claim on {what} given back"
        else:
            return
        if self._told.get(uav) != words:
            self._told[uav] = words
            self._log.add(uav, "claim", level, words)

    def view(self) -> dict[str, Any]:
        """Return who holds what, for the pages."""
        now_ns = self._steady_ns()
        leases = [
            {
                "id": str(lease.lease_id),  # a number of 62 bits, which a page would round
                "uav": lease.uav,
                "kind": lease.kind,
                "tree": lease.tree_id,
                "left": round((lease.until_ns - now_ns) / 1e9, 1),
            }
            for lease in sorted(self.book.leases.values(), key=lambda lease: (lease.uav, lease.lease_id))
            if lease.until_ns > now_ns
        ]
        waits_s = max(0.0, (self.book.silent_until_ns - now_ns) / 1e9)
        return {"leases": leases, "visited": len(self.book.done), "waits": round(waits_s, 1)}

    def close(self) -> None:
        """Let go of the book's file."""
        self._journal.close()
