"""Two halves of one work, each on a core of its own where there are two.

The halves are the same whether or not a second core is there, and no half sees what the other does: the result never
depends on the machine.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

_SMALL = 20_000
"""Below so many items the second thread costs more than it gains."""


class _Helper:
    """One thread, begun at first use."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None

    def run(self, work: Callable[[int], None]) -> None:
        """Do ``work(1)`` in the thread and ``work(0)`` here."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="detector-half")
        other = self._pool.submit(work, 1)
        try:
            work(0)
        finally:
            other.result()


_helper = _Helper()
_two_cores = (os.cpu_count() or 1) > 1


def both_halves(work: Callable[[int], None], items: int = _SMALL) -> None:
    """Call ``work(0)`` and ``work(1)``; at once when there are many items (kernels must release the GIL)."""
    if _two_cores and items >= _SMALL:
        _helper.run(work)
    else:
        work(0)
        work(1)


def half_of(count: int, half: int) -> tuple[int, int]:
    """Return begin and end of a half of ``count`` items."""
    middle = count // 2
    return (0, middle) if half == 0 else (middle, count)
