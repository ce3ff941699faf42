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
        self._until: dt.datetime | None = None
        if security.folder is None:
            return
        try:
            self._until = Register.read(security.folder).valid_until(shown_by(security, uav, service).text)
        except InputError as error:
            LOG.warning("when the certificate ends cannot be told: %s", error)

    def tell(self, book: HealthBook, now: dt.datetime) -> None:
        """Put the minutes left into health; nothing where none is known."""
        if self._until is not None:
            book.level(_LEFT, int((self._until - now).total_seconds() // 60))


def told_days_left(counters: Mapping[str, int]) -> float | None:
    """Return the days left as health tells them; None: it does not."""
    return counters[_LEFT] / 1440.0 if _LEFT in counters else None
