"""Notices that the list of certificates changed, so that a revoked one is refused without anybody restarting the router."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from services.common.context import Context
from services.common.errors import InputError
from services.security.config import SecurityConfig
from services.security.identity import Identity
from services.security.register import Register

LOG = logging.getLogger(__name__)

_LOOK_S = 1.0


class RegisterWatch:
    """Looks at ``identities.json`` once a second, and calls ``on_change`` when other certificates have rights.

    A list that cannot be read changes nothing: the rights in force stay, and health says what is wrong.
    """

    def __init__(self, security: SecurityConfig, on_change: Callable[[], None]) -> None:
        self._folder = security.folder
        self._on_change = on_change
        self._names: Mapping[str, Identity] | None = None if self._folder is None else self._read()

    def register(self, context: Context) -> None:
        """Look from now on."""
        if self._folder is not None:
            context.every_wall(_LOOK_S, lambda: self.look(context))

    def look(self, context: Context) -> None:
        """Compare the list with the one in force."""
        try:
            names = self._read()
        except InputError as error:
            context.health.note("certificates", f"{error}; the rights in force stay as they are")
            return
        context.health.note("certificates", "")
        if names != self._names:
            LOG.warning("the list of certificates changed: this router ends, to be started with the new rights")
            self._on_change()

    def _read(self) -> Mapping[str, Identity]:
        assert self._folder is not None
        return Register.read(self._folder).valid_names()
