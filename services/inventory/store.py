"""Which database the inventory lies in, and the lock that keeps two stations out of one file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from services.common.errors import InputError
from services.common.files import is_there, locked_beside
from services.inventory.geopackage import GeoPackage
from services.inventory.values import Changes, Contents, Site

_TAKEN = "another station writes to it; name another with --set station.inventory.database=FILE"


class Store(Protocol):
    """A database that holds an inventory."""

    def load(self) -> Contents:
        """Return everything but history and log."""
        ...

    def rows(self, table: str, where: str = "") -> list[dict[str, Any]]:
        """Return a table's rows as mappings."""
        ...

    def write(self, changes: Changes, sites: dict[int, Site]) -> None:
        """Write all changes in one transaction."""
        ...

    def close(self) -> None:
        """Close it."""
        ...


def default_path() -> Path:
    """Return where the inventory lies when nothing else is said."""
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "treedock" / "inventory.gpkg"


def open_store(database: str, *, read_only: bool = False) -> Store:
    """Open a GeoPackage by its path, or PostGIS by a URL; ``read_only`` takes no lock and makes no file.

    Raises:
        InputError: what cannot be opened, with what to do.
    """
    if database.startswith(("postgresql://", "postgres://")):
        from services.inventory.postgis import PostGis

        return PostGis(database, read_only=read_only)
    path = Path(database).expanduser() if database else default_path()
    if read_only:
        if not is_there(path):
            raise InputError(f"inventory {path}: there is no such file; name one with --database FILE")
        return GeoPackage(path, read_only=True)
    return _Locked(path)


class _Locked(GeoPackage):
    """A GeoPackage that no other station writes to meanwhile."""

    def __init__(self, path: Path) -> None:
        self._lock = locked_beside(path, "inventory", _TAKEN)
        try:
            super().__init__(path)
        except InputError:
            self._lock.close()
            raise

    def close(self) -> None:
        """Close the file, then let go of the lock."""
        super().close()
        self._lock.close()
