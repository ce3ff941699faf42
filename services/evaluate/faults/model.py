"""A row of the fault matrix, and what running it gave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.evaluate.faults.bench_rig import Bench


@dataclass(frozen=True, slots=True)
class Result:
    """What a row gave; it passed when nothing failed and it was not skipped."""

    failed: tuple[str, ...] = ()
    """What did not hold, in words."""
    measured: Mapping[str, float | None] = field(default_factory=dict)
    told: tuple[str, ...] = ()
    """One line per fault."""
    skipped: str = ""
    """Why it could not be run here."""

    @property
    def passed(self) -> bool:
        """Whether it was run and everything held."""
        return not self.failed and not self.skipped


@dataclass(frozen=True, slots=True)
class Row:
    """One fault: what is done, what must hold, and the function that does and measures it."""

    name: str
    group: str
    """Where it is run: flight (missions with stand-ins), chain (the real services over a recording), machine, network."""
    done: str
    holds: str
    run: Callable[[Bench], Result]
