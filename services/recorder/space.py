"""How much room the recorder's disk has, told in its health: nobody else may see that disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.common.context import HealthBook

_FREE, _RESERVE = "disk_free_mb", "disk_reserve_mb"
_MB = 1_000_000


def free_bytes(folder: Path) -> int:
    """Return what a user without rights may still write.

    Raises:
        OSError: the folder is gone.
    """
    status = os.statvfs(folder)
    return status.f_bavail * status.f_frsize


def tell_space(book: HealthBook, folder: Path, reserve_mb: int) -> None:
    """Put room and reserve into health; a folder that is gone has none."""
    try:
        free = free_bytes(folder)
    except OSError:
        free = 0
    book.level(_FREE, free // _MB)
    book.level(_RESERVE, reserve_mb)


def told_space_bytes(counters: Mapping[str, int]) -> tuple[int | None, int | None]:
    """Return room and reserve as health tells them; None and None: it does not."""
    if _FREE not in counters:
        return None, None
    return counters[_FREE] * _MB, counters.get(_RESERVE, 0) * _MB
