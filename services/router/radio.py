"""Notices radio interfaces that this machine does not have: behind a name that is wrong nothing is thinned or held back."""

from __future__ import annotations

import logging
import socket
from collections.abc import Sequence

from services.common.context import Context

LOG = logging.getLogger(__name__)

_LOOK_S = 5.0


def absent(interfaces: Sequence[str]) -> list[str]:
    """Return those of ``interfaces`` that are none of this machine's now."""
    here = {name for _, name in socket.if_nameindex()}
    return [name for name in interfaces if name not in here]


def in_words(names: Sequence[str]) -> str:
    """Return what is wrong with absent interfaces."""
    return f"{', '.join(names)}: no network interface here (security.radio_interfaces): no radio is spared behind that name"


class RadioWatch:
    """Tells in log and health while an interface is not there: a radio may also be plugged in later."""

    def __init__(self, interfaces: Sequence[str]) -> None:
        self._interfaces = interfaces
        self._told: list[str] = []

    def register(self, context: Context) -> None:
        """Look now, and from now on."""
        if self._interfaces:
            self.look(context)
            context.every_wall(_LOOK_S, lambda: self.look(context))

    def look(self, context: Context) -> None:
        """Compare the names with what is there."""
        names = absent(self._interfaces)
        words = in_words(names) if names else ""
        context.health.note("radio", words)
        if words and names != self._told:
            LOG.warning("%s", words)
        self._told = names
