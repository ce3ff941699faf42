"""Keeps the inventory on a thread of its own: what comes is merged and committed every half second.

The station's work loop only leaves the newest list of each flight here, so that a slow disk never holds it up; lists
that were replaced before their turn hold nothing that the newer one does not.
"""

from __future__ import annotations

import logging
import sqlite3
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from schemas.trees import TreeList
from services.common.logging import Throttle
from services.inventory.book import Inventory
from services.inventory.config import InventoryConfig
from services.inventory.store import Store
from services.inventory.values import AuditLine, Changes

LOG = logging.getLogger(__name__)

_MOST_WAITING = 50_000
"""Measurements and events that wait for a disk that does not take them; older ones are given up, and that is told."""


Tone = Literal["info", "good", "bad"]


@dataclass(frozen=True, slots=True)
class Offered:
    """A flight's newest list, the trees that it has docked at, and whether its map was begun in the air."""

    trees: TreeList
    visited: frozenset[int]
    in_air: bool


class Keeper:
    """The thread that merges and commits. ``tell`` hears of trouble and of its end, from that thread."""

    def __init__(self, store: Store, config: InventoryConfig, tell: Callable[[str, Tone], None]) -> None:
        self._store = store
        self._config = config
        self._tell = tell
        self.inventory = Inventory(config, store.load())
        self.laid = self.inventory.laid()
        """Where maps lie on the earth: made anew, never changed, so that any thread may read it."""
        self.commits = 0
        self.commit_ms = 0.0
        """The slowest commit so far."""
        self.given_up = 0
        self._offered: dict[tuple[str, str], Offered] = {}
        self._audit: list[AuditLine] = []
        self._waiting = Changes()
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._in_trouble = False
        self._notes: dict[int, str] = {}
        self._throttle = Throttle(10.0)
        self._thread = threading.Thread(target=self._run, name="inventory", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def offer(self, uav: str, trees: TreeList, visited: frozenset[int], *, in_air: bool = False) -> None:
        """Leave a flight's newest list; returns at once."""
        with self._lock:
            self._offered[uav, trees.map_id] = Offered(trees, visited, in_air)

    def audit(self, line: AuditLine) -> None:
        """Leave a line of the log; returns at once."""
        with self._lock:
            self._audit.append(line)

    def close(self, within_s: float = 0.4) -> None:
        """Commit what is left and close the database."""
        self._stop.set()
        self._thread.join(within_s)

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stop.is_set():
            next_s = max(next_s + self._config.commit_s, time.monotonic())
            self._stop.wait(next_s - time.monotonic())
            try:
                self.turn(time.time_ns())
            except Exception:  # a bug here must be told, and must not end the station, which commands aircraft
                LOG.exception("this is a bug: the inventory takes nothing more until the station is started again")
                self._tell("the inventory stopped by a bug: start the station again", "bad")
                break
        self._store.close()

    def turn(self, now_ns: int) -> None:
        """Merge what was left here and commit it."""
        with self._lock:
            offered, self._offered = self._offered, {}
            audit, self._audit = self._audit, []
        for (uav, _), item in offered.items():
            flight = self.inventory.take(uav, item.trees, now_ns, item.visited, in_air=item.in_air)
            if self._notes.get(flight.fid) != flight.note:
                self._notes[flight.fid] = flight.note
                self._tell(f"inventory: {uav}, flight {flight.fid}: {flight.note}", "info")
        changes = self.inventory.written()
        changes.audit += audit
        self._waiting.add(changes)
        self._bound()
        if self._waiting:
            self._commit()
        self.inventory.join_next(now_ns)  # after the commit, and one at a time: no list waits for it
        self.laid = self.inventory.laid()

    def _commit(self) -> None:
        begin_s = time.monotonic()
        try:
            self._store.write(self._waiting, self.inventory.sites)
        except (sqlite3.Error, OSError, getattr(self._store, "failure", OSError)) as error:
            self._throttle.log(LOG, logging.ERROR, "commit", f"the inventory cannot be written: {error}")
            if not self._in_trouble:
                self._in_trouble = True
                self._tell(f"the inventory cannot be written: {error}", "bad")
            return
        if self._in_trouble:
            self._in_trouble = False
            self._tell("the inventory is written again", "good")
        self._waiting = Changes()
        self.commits += 1
        self.commit_ms = max(self.commit_ms, (time.monotonic() - begin_s) * 1e3)

    def _bound(self) -> None:
        for rows in (self._waiting.measurements, self._waiting.audit):
            surplus = len(rows) - _MOST_WAITING
            if surplus > 0:
                del rows[:surplus]
                self.given_up += surplus
