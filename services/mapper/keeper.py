"""Keeps the map on disk while the service works, and gives it back after a restart. The disk is never waited for."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from services.mapper.dense_map import MapSubmap
from services.mapper.saved_map import SavedMap, SavedMapError, set_aside, unpack, write_map

LOG = logging.getLogger(__name__)

_NOTE = "map file"
_LAST_WORD_S = 0.3
"""A service that stops has half a second; the old file stays whole whatever happens."""


class MapKeeper:
    """One file, one writer thread at a time."""

    def __init__(self, file: Path, count: Callable[[str], None], note: Callable[[str, str], None]) -> None:
        """Keep the map in ``file``; ``count`` and ``note`` are the health book's."""
        self._file = file
        self._count, self._note = count, note
        self._writer: threading.Thread | None = None
        self._result: str | None = None
        """Set by the writer: an error's words, or nothing."""

    def load(self) -> SavedMap | None:
        """Return the saved map; a file that is none is set aside, counted and told by name, and never stops anybody."""
        try:
            data = self._file.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._tell(f"{self._file}: cannot be read: {error.strerror}; the map begins anew")
            return None
        try:
            return unpack(data)
        except SavedMapError as error:
            self._count("bad_map_files")
            self._tell(f"{self._file}: {error}; {self._aside()}; the map begins anew")
            return None

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
        if self._result is None:
            self._count("maps_saved")
            self._note(_NOTE, "")
        else:
            self._count("map_save_errors")
            self._tell(self._result)

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
        try:
            write_map(self._file, snapshot)
            self._result = None
        except OSError as error:
            self._result = f"{self._file}: cannot be written: {error.strerror}; the map would not survive a restart"

    def _aside(self) -> str:
        try:
            return f"it was set aside as {set_aside(self._file).name}"
        except OSError as error:
            return f"it cannot be set aside: {error.strerror}"

    def _tell(self, text: str) -> None:
        LOG.warning(text)
        self._note(_NOTE, text)
