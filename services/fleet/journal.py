"""The book's file: written whole before a grant is told, locked against a second arbiter on the same machine."""

from __future__ import annotations

import errno
import json
import logging
import secrets
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from services.common.errors import InputError
from services.common.files import locked_beside, write_whole
from services.fleet.book import Memory
from services.fleet.config import FleetConfig
from services.inventory.store import default_path

LOG = logging.getLogger(__name__)

_TAKEN = (
    "another arbiter keeps this book; a fleet has one: switch station.fleet.enabled off here, or name another file with "
    "station.fleet.book"
)

Origin = tuple[float, float, float]


def book_path(config: FleetConfig) -> Path:
    """Return where the book lies."""
    return Path(config.book).expanduser() if config.book else default_path().with_name("fleet.json")


class _File(BaseModel):
    """What the file holds; checked, because people copy and edit files."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: int
    name: str
    origin_deg: Origin
    memory: Memory


class Journal:
    """One arbiter's file. ``memory`` is None when there is no trustworthy one: the arbiter then waits for a lease."""

    def __init__(self, path: Path, origin_deg: Origin | None) -> None:
        """Open or begin the file; ``origin_deg`` is the shared frame's origin of a new one.

        Raises:
            InputError: another arbiter has it, or the folder cannot be written.
        """
        self._path = path
        self._lock = locked_beside(path, "the fleet's book", _TAKEN)
        found = self._read()
        self.name = found.name if found else f"arbiter-{secrets.token_hex(4)}"
        self.origin_deg = found.origin_deg if found else origin_deg or (0.0, 0.0, 0.0)
        self.memory = found.memory if found else None

    def write(self, memory: Memory) -> None:
        """Put ``memory`` on the disk.

        Raises:
            OSError: the disk refused; the file is as it was.
        """
        body: dict[str, Any] = {"format": 1, "name": self.name, "origin_deg": self.origin_deg, "memory": asdict(memory)}
        try:
            like = (
                self._path.stat() if self._path.exists() else None
            )  # the station's, also when an administrator writes
            write_whole(self._path, json.dumps(body, indent=1).encode(), mode=0o600, like=like)
        except InputError as error:
            raise OSError(errno.EIO, str(error)) from error

    def close(self) -> None:
        """Let go of the file."""
        self._lock.close()

    def _read(self) -> _File | None:
        try:
            found = _File.model_validate_json(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except (OSError, ValidationError) as error:
            self._set_aside(str(error).splitlines()[0])
            return None
        if found.format != 1:
            raise InputError(
                f"{self._path}: format {found.format}, expected 1: written by a newer treedock; update this one"
            )
        return found

    def _set_aside(self, why: str) -> None:
        kept = self._path.with_suffix(".broken")
        LOG.error(
            "%s: cannot be read (%s): visited trees are forgotten, the file is kept as %s", self._path, why, kept.name
        )
        if self._path.exists():
            self._path.replace(kept)
