"""Rows of numbers that are appended one by one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FIRST = 256


class Rows:
    """A growing array of ``dtype``, no longer than ``most``; its room is kept when it begins anew.

    Objects in a list that is dropped leave holes in the heap; a service that does so at each mission grows over a day.
    """

    def __init__(self, dtype: np.dtype[Any], most: int) -> None:
        self._rows = np.empty(min(_FIRST, most), dtype)
        self._most = most
        self._count = 0

    def __len__(self) -> int:
        """Return how many there are."""
        return self._count

    def append(self, row: object) -> None:
        """Add a row, unless there are ``most`` already."""
        if self._count >= self._most:
            return
        if self._count == len(self._rows):
            self._rows = np.concatenate(
                [self._rows, np.empty(min(len(self._rows), self._most - self._count), self._rows.dtype)]
            )
        self._rows[self._count] = row
        self._count += 1

    def clear(self) -> None:
        """Begin anew."""
        self._count = 0

    @property
    def last(self) -> Any:  # noqa: ANN401
        """The newest row; there must be one."""
        return self._rows[self._count - 1]

    @property
    def values(self) -> NDArray[Any]:
        """A copy of all rows."""
        return self._rows[: self._count].copy()
