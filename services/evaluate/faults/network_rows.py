"""Rows over three machines with a router between (network namespaces)."""

from __future__ import annotations

from functools import partial

from services.evaluate.faults.bench_rig import Bench
from services.evaluate.faults.model import Result, Row
from services.evaluate.faults.split import in_namespaces

_PLACES = (
    "camera, autopilot and simulator; slam, refiner; mapper, detector, navigator: three machines, a router between"
)


def rows() -> list[Row]:
    """Return the rows."""
    docks = (
        "the mission docks; frames cross compressed, and none raw (bytes on the wires, rates in health); the offsets are measured "
        "and corrected within 20 ms and the doctor names them"
    )
    cut = "hold within 0.5 s, land with a reason; when the cable is in again all are together within 30 s without a restart"
    flap = "hold within 0.5 s, go on or land with a reason; all are together again without a restart"
    return [
        Row("split", "network", f"{_PLACES}; two clocks are 200 ms ahead and behind", docks, partial(_run, case="split")),
        Row("split rendered", "rendered", "the same with the real slam, mapper, detector and refiner", docks,
            partial(_run, case="split-rendered")),
        Row("link cut: slam", "network", "the cable of slam and refiner is pulled for good", cut, partial(_run, case="cut-B")),
        Row("link cut: navigator", "network", "the cable of mapper, detector and navigator is pulled for good", cut,
            partial(_run, case="cut-C")),
        Row("link flaps: slam", "network", "the cable of slam and refiner is out for 1 s", flap, partial(_run, case="flap-B")),
        Row("link flaps: navigator", "network", "the cable of mapper, detector and navigator is out for 1 s", flap,
            partial(_run, case="flap-C")),
    ]  # fmt: skip


def _run(bench: Bench, case: str) -> Result:
    bench.close()
    return in_namespaces(case, bench.seed, bench.moments, bench.fresh(), bench.tell)
