"""Rows of numbers that are appended one by one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIRST = 256


class Rows:
    """A growing array of ``dtype``, no longer than ``most``; its room is kept when it begins anew.

    When it is full every second row goes, and of those to come only every second is taken, and so on: from the first
    to the last they are as dense everywhere.

    Objects in a list that is dropped leave holes in the heap; a service that does so at each mission grows over a day.
    """

    def __init__(self, dtype: np.dtype[Any], most: int) -> None:
        self._rows = np.empty(min(_FIRST, most), dtype)
        self._most = most
        self._count = 0
        self._came, self._step = 0, 1

    def __len__(self) -> int:
        """Return how many there are."""
        return self._count

    def append(self, row: object) -> None:
        """Add a row; when there are ``most`` already, thin."""
        number, self._came = self._came, self._came + 1
        if number % self._step:
            return
        if self._count == self._most:
            self._thin()
            if number % self._step:
                return
        if self._count == len(self._rows):
            self._rows = np.concatenate(
                [self._rows, np.empty(min(len(self._rows), self._most - self._count), self._rows.dtype)]
            )
        self._rows[self._count] = row
        self._count += 1

    def _thin(self) -> None:
        kept = self._rows[: self._count : 2].copy()
        self._rows[: len(kept)] = kept
        self._count, self._step = len(kept), 2 * self._step

    def clear(self) -> None:
        """Begin anew."""
        self._count = 0
        self._came, self._step = 0, 1

    @property
    def last(self) -> Any:  # noqa: ANN401
        """The newest row that was kept; there must be one."""
        return self._rows[self._count - 1]

    @property
    def values(self) -> NDArray[Any]:
        """A copy of all rows."""
        return self._rows[: self._count].copy()
