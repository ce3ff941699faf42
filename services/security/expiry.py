"""When the certificate that a service shows ends: told in its health, for a link whose certificate ends is closed, in flight too."""

from __future__ import annotations

import datetime as dt
import logging
from collections.abc import Mapping

from services.common.context import HealthBook
from services.common.errors import InputError
from services.security.config import SecurityConfig
from services.security.register import Register
from services.security.transport import shown_by

LOG = logging.getLogger(__name__)

_LEFT = "certificate_minutes_left"


class Expiry:
    """The end of a service's certificate by the list of certificates that came with it; a plain bus has none.

    Of an identity's certificates one is valid at a time: the router lets no other do anything, so that one is shown.
    """

    def __init__(self, security: SecurityConfig, uav: str, service: str) -> None:
        self._folder = security.folder
        self._identity = "" if self._folder is None else shown_by(security, uav, service).text
        self._until: dt.datetime | None = None
        self._read_of: tuple[int, int] | None = None
        self._look()

    def tell(self, book: HealthBook, now: dt.datetime) -> None:
        """Put the minutes left into health; nothing where none is known. A renewal since the last time counts."""
        self._look()
        if self._until is not None:
            book.level(_LEFT, int((self._until - now).total_seconds() // 60))

    def _look(self) -> None:
        """Read the list where it is another than last time; one that cannot be read changes nothing."""
        if self._folder is None:
            return
        try:
            status = (self._folder / Register.FILE).stat()
            found = (status.st_mtime_ns, status.st_ino)
        except OSError:
            found = (0, 0)  # told by who reads it
        if found == self._read_of:
            return
        self._read_of = found
        try:
            self._until = Register.read(self._folder).valid_until(self._identity)
        except InputError as error:
            LOG.warning("when the certificate ends cannot be told: %s", error)


def told_days_left(counters: Mapping[str, int]) -> float | None:
    """Return the days left as health tells them; None: it does not."""
    return counters[_LEFT] / 1440.0 if _LEFT in counters else None
