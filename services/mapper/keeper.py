"""Keeps the map on disk while the service works, and gives it back after a restart. The disk is never waited for."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from services.common.state import StateFile
from services.mapper.dense_map import MapSubmap
from services.mapper.saved_map import SavedMap, pack, unpack

_LAST_WORD_S = 0.3
"""A service that stops has half a second; the old file stays whole whatever happens."""


class MapKeeper:
    """One file, one writer thread at a time."""

    def __init__(self, file: Path, count: Callable[[str], None], note: Callable[[str, str], None]) -> None:
        """Keep the map in ``file``; ``count`` and ``note`` are the health book's."""
        self._state = StateFile(file, "map", "the map", count, note)
        self._writer: threading.Thread | None = None
        self._fault = ""
        """Set by the writer: why it failed, or nothing."""

    def load(self) -> SavedMap | None:
        """Return the saved map; a file that is none is set aside, counted and told by name, and never stops anybody."""
        return self._state.read(unpack)

    def save(self, map_id: str, graph_version: int, submaps: list[MapSubmap]) -> bool:
        """Begin to write the map; False when the last writing still goes on."""
        self.look()
        if self._writer is not None:
            return False
        snapshot = SavedMap(map_id, graph_version, [replace(s) for s in submaps])  # its arrays are never written to
        self._writer = threading.Thread(target=self._write, args=(snapshot,), name="map-file", daemon=True)
        self._writer.start()
        return True

    def look(self) -> None:
        """Note what became of the last writing."""
        if self._writer is None or self._writer.is_alive():
            return
        self._writer = None
        self._state.tell_written(self._fault)

    def finish(self, save: Callable[[], bool]) -> None:
        """Write a last time, as far as the time of a stopping service allows."""
        for _ in range(2):  # what is being written is older than the last change
            if self._writer is not None:
                self._writer.join(_LAST_WORD_S / 4)
            if save():
                break
        if self._writer is not None:
            self._writer.join(_LAST_WORD_S)
        self.look()

    def _write(self, snapshot: SavedMap) -> None:
        self._fault = self._state.write(pack(snapshot), lasting=True)
