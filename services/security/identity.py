"""Who may be on the bus: a certificate's name says which aircraft and which role."""

from __future__ import annotations

import re
from dataclasses import dataclass

from schemas.topics import ANY, TOPICS
from services.common.errors import InputError

STATION = "station"
READER = "reader"
"""Tools that look and never speak: ``treedock topic``, ``doctor``, the supervisor of ``treedock run``."""
RECORDER = "recorder"
_MORE_ROLES = (READER, RECORDER, "router", "preview", "supervisor")

ROLES: tuple[str, ...] = tuple(
    sorted({role for t in TOPICS for role in (t.producer, *t.consumers) if role != ANY} | set(_MORE_ROLES))
)
"""Every role that a certificate can be issued for."""

EVERY_AIRCRAFT = "*"
_NAME = re.compile(r"[A-Za-z0-9_-]+\Z")


@dataclass(frozen=True, slots=True)
class Identity:
    """A role aboard one aircraft, or a station that serves all aircraft of its network."""

    text: str
    """As people write it: ``uav1.slam``, ``station.alice``."""
    role: str
    uav: str
    """Aircraft whose keys it deals with; ``*`` for a station."""

    @classmethod
    def parse(cls, text: str) -> Identity:
        """Read ``{uav}.{role}`` or ``station.{name}``.

        Raises:
            InputError: it is neither; the roles are named.
        """
        first, dot, second = text.partition(".")
        if dot and _NAME.match(first) and _NAME.match(second):
            if first == STATION:
                return cls(text, STATION, EVERY_AIRCRAFT)
            if second in ROLES:
                return cls(text, second, first)
        raise InputError(
            f"identity {text!r}: expected {{aircraft}}.{{role}} with one of the roles {', '.join(ROLES)}, "
            f"or {STATION}.{{name}}; for example uav1.slam or station.alice"
        )
