"""What the station keeps: trees and log go to the inventory, and its exports come back for the page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from services.common.context import HealthBook
from services.inventory.config import InventoryConfig
from services.inventory.export import csv_bytes, geojson_bytes, tree_rows
from services.inventory.keeper import Keeper, Tone
from services.inventory.store import open_store
from services.inventory.values import AuditLine, Laid
from services.station.aircraft import Aircraft
from services.station.events import Event, EventLog
from services.station.web import Download


class Keeping:
    """Joins the station to the inventory; with ``database = "none"`` it does nothing."""

    def __init__(
        self, config: InventoryConfig, log: EventLog, health: HealthBook, call: Callable[[Callable[[], None]], None]
    ) -> None:
        """Open the inventory. ``call`` has the work loop do something.

        Raises:
            InputError: a database that cannot be opened.
        """
        self._config = config
        self._log = log
        self._health = health
        self._call = call
        self.keeper: Keeper | None = None
        if config.database != "none":
            self.keeper = Keeper(open_store(config.database), config, self._on_trouble)

    def start(self) -> None:
        """Begin to keep."""
        if self.keeper is not None:
            self._log.listeners.append(self._audit)
            self.keeper.start()

    def trees(self, aircraft: Aircraft) -> None:
        """Offer an aircraft's newest list, with the trees docked at in the same map."""
        mission, trees = aircraft.mission, aircraft.trees
        if self.keeper is None or trees is None:
            return
        same = mission is not None and mission.map_id == trees.map_id
        visited = mission.visited_tree_ids if mission is not None and same else ()
        in_air = aircraft.map_begun_in_air and aircraft.trail_map == trees.map_id
        self.keeper.offer(aircraft.uav, trees, frozenset(visited), in_air=in_air)

    def laid(self) -> dict[tuple[str, str], Laid]:
        """Return where the maps of flights lie on the earth, as far as the inventory knows."""
        return {} if self.keeper is None else self.keeper.laid

    def close(self) -> None:
        """Commit what is left."""
        if self.keeper is not None:
            self.keeper.close()

    def _audit(self, event: Event) -> None:
        assert self.keeper is not None
        self.keeper.audit(AuditLine(event.time_ns, event.uav, event.kind, event.level, event.who, event.text))

    def _on_trouble(self, text: str, tone: Tone) -> None:
        self._call(lambda: self._tell(text, tone))

    def _tell(self, text: str, tone: Tone) -> None:
        self._log.add("", "inventory", tone, text)
        if tone != "info":
            self._health.note("inventory", text if tone == "bad" else "")

    def downloads(self) -> dict[str, Download]:
        """Return the exports by file name."""
        if self.keeper is None:
            return {}
        return {
            "trees.csv": lambda: (csv_bytes(self._rows()), "text/csv; charset=utf-8"),
            "trees.geojson": lambda: (geojson_bytes(self._rows()), "application/geo+json"),
        }

    def _rows(self) -> list[dict[str, Any]]:
        store = open_store(self._config.database, read_only=True)
        try:
            return tree_rows(*(store.rows(name) for name in ("trees", "trees_local", "sites")))
        finally:
            store.close()
