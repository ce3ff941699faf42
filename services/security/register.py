"""The list of issued certificates: who holds which, until when, and which are revoked. Read by every router."""

from __future__ import annotations

import datetime as dt
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import ClassVar

from services.common.errors import InputError
from services.common.files import write_whole
from services.security.identity import Identity


@dataclass(frozen=True, slots=True)
class Issued:
    """One certificate."""

    common_name: str
    """Identity and generation (``uav1.slam.2``): a renewed certificate is told from the one it replaces."""
    identity: str
    serial: str
    valid_from: str
    valid_until: str
    hosts: tuple[str, ...] = ()
    revoked: bool = False


@dataclass(frozen=True, slots=True)
class Register:
    """All certificates of an authority, oldest first."""

    entries: tuple[Issued, ...]

    FILE: ClassVar[str] = "identities.json"

    def next_generation(self, identity: str) -> int:
        """Return the number of an identity's next certificate."""
        return 1 + sum(entry.identity == identity for entry in self.entries)

    def added(self, entry: Issued) -> Register:
        """Return the list with one more."""
        return Register((*self.entries, entry))

    def revoked(self, identity: str) -> Register:
        """Return the list with all certificates of ``identity`` revoked."""
        return Register(tuple(replace(e, revoked=e.revoked or e.identity == identity) for e in self.entries))

    def valid_names(self) -> dict[str, Identity]:
        """Return the common names that have rights."""
        return {e.common_name: Identity.parse(e.identity) for e in self.entries if not e.revoked}

    def valid_until(self, identity: str) -> dt.datetime | None:
        """Return when the certificate of ``identity`` that has rights ends; None: it has none."""
        ends = [e.valid_until for e in self.entries if e.identity == identity and not e.revoked]
        return dt.datetime.fromisoformat(ends[-1]) if ends else None

    def write(self, folder: Path) -> None:
        """Write the list.

        Raises:
            InputError: the folder cannot be written.
        """
        body = {"version": 1, "issued": [asdict(entry) for entry in self.entries]}
        write_whole(folder / self.FILE, (json.dumps(body, indent=1) + "\n").encode())

    @classmethod
    def read(cls, folder: Path) -> Register:
        """Read the list of a folder.

        Raises:
            InputError: it is missing, damaged, or of a newer treedock.
        """
        path = folder / cls.FILE
        try:
            body = json.loads(path.read_text())
            version = body["version"]
            if version != 1:
                raise InputError(f"{path}: version {version!r} was written by a newer treedock; this one knows 1")
            entries = [Issued(**{**entry, "hosts": tuple(entry["hosts"])}) for entry in body["issued"]]
            for entry in entries:
                Identity.parse(entry.identity)
                dt.datetime.fromisoformat(entry.valid_until)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}; `treedock certs export` puts it there") from error
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged ({error}); copy it again from the authority's folder") from error
        return cls(tuple(entries))
