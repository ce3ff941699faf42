"""What the rows share: the systems they harm, started when first needed, the limits, the random moments."""

from __future__ import annotations

import contextlib
import itertools
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from services.common.errors import InputError
from services.evaluate.faults.missions import Flights
from services.evaluate.faults.rig import FUSED, ONBOARD, Rig
from services.evaluate.faults.system import flight_config
from services.evaluate.faults.verdict import Limits

if TYPE_CHECKING:
    from services.evaluate.faults.chain import Chain

GROUND = ("preview", "station")
_READY_WITHIN_S = 300.0


@dataclass
class Bench:
    """Systems under test. ``close`` ends them all."""

    seed: int
    folder: Path
    limits: Limits = field(default_factory=Limits)
    fresh_seed: int | None = None
    """Of the recording; None: the named scene."""
    moments: int = 3
    """How often each process is harmed in a row."""
    tell: Callable[[str], None] = lambda _: None
    _flights: Flights | None = None
    _chain: Chain | None = None
    _rngs: dict[str, np.random.Generator] = field(default_factory=dict)
    _stack: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    _number: Iterator[int] = field(default_factory=itertools.count)

    def rng(self, row: str) -> np.random.Generator:
        """Return the random numbers of a row: they begin the same for a seed, whatever was run before."""
        if row not in self._rngs:
            self._rngs[row] = np.random.default_rng([self.seed, zlib.crc32(row.encode())])
        return self._rngs[row]

    def fresh(self) -> Path:
        """Return an empty folder."""
        folder = self.folder / f"run-{next(self._number)}"
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def flights(self, row: str, *, fused: bool = False) -> Flights:
        """Return the missions, on a system that is up and whole, with an aircraft that flies or stands where it may start.

        ``fused``: with fusion and a second camera aboard.
        """
        if self._flights is not None and (FUSED[0] in self._flights.rig.services) != fused:
            self.close()
        if self._flights is not None and self._flights.cramped:
            self.tell("the aircraft landed beside a tree: another begins at the start")
            self.close()
        if self._flights is None:
            folder = self.fresh()
            services = (*ONBOARD, *(FUSED if fused else ()), *GROUND, "simulator")
            rig = self._stack.enter_context(Rig(flight_config(self.seed, folder, fused=fused), folder, services))
            if not rig.until(lambda: rig.all_ready, _READY_WITHIN_S):
                raise InputError(f"not ready within {_READY_WITHIN_S:.0f} s: see {folder}")
            self._flights = Flights(rig, self.rng(row), self.tell)
        self._flights.rng = self.rng(row)
        return self._flights

    def chain(self) -> Chain:
        """Return the real services over a recording."""
        from services.evaluate.faults.chain import Chain

        if self._chain is None:
            self._chain = self._stack.enter_context(Chain.over_a_recording(self.fresh_seed, self.folder, self.tell))
        return self._chain

    def close(self) -> None:
        """End what runs; the next row begins anew."""
        self._flights = self._chain = None
        self._stack.close()
