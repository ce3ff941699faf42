"""What pages say, handed over from the web's thread to the work loop. It decides nothing."""

from __future__ import annotations

import time
from collections.abc import Callable

from services.station.brain import Brain
from services.station.requests import Request


class Ears:
    """Calls the brain on the work loop. ``call`` takes what it is to do, from any thread."""

    def __init__(self, call: Callable[[Callable[[], None]], None], brain: Callable[[], Brain]) -> None:
        self._call = call
        self._brain = brain
        """Asked for when it is needed: the site that these ears belong to is made first."""

    def opened(self, page: int, address: str) -> None:
        """Hand over."""
        self._call(lambda: self._brain().on_open(page, address))

    def closed(self, page: int) -> None:
        """Hand over."""
        self._call(lambda: self._brain().on_close(page, time.monotonic()))

    def said(self, page: int, request: Request) -> None:
        """Hand over."""
        self._call(lambda: self._brain().on_request(page, request, time.monotonic()))

    def misspoke(self, page: int, why: str) -> None:
        """Hand over."""
        self._call(lambda: self._brain().refuse(page, why))
