"""``kill -9`` of the detector over real Zenoh: the next one calls every tree by the id that the last one gave it."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np

from schemas.mapping import MapIndex, Submap
from schemas.topics import MAP_CLOUD, MAP_INDEX, TREES_LIST
from schemas.trees import TreeList
from services.common.bus import Bus
from tests.process.conftest import ROOT, System, until
from tests.unit.detector_clouds import facing, ground, trunk
from tests.unit.detector_world import submap_of

FAR, NEAR = (4.0, -1.5), (2.5, 0.9)


def tree(place: tuple[float, float]) -> np.ndarray:
    return trunk(*place, 0.10, np.random.default_rng(1), arc=facing(*place))


def start(system: System) -> subprocess.Popen[bytes]:
    config = system.folder / "config.json"
    config.write_text(json.dumps({"detector": {"state_dir": str(system.folder / "state")}}))
    command = [
        sys.executable,
        "-m",
        "services.cli.app",
        "detector",
        "--config",
        str(config),
        "--port",
        str(system.port),
    ]
    with system.log("detector").open("ab") as log:
        process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
    system.processes.append(process)
    return process


def index(submaps: list[Submap]) -> MapIndex:
    return MapIndex(
        stamp_ns=1, map_id="m1", epoch=1, graph_version=3, ground_sequence=0,
        submap_ids=tuple(s.submap_id for s in submaps), versions=tuple(s.version for s in submaps),
        placed_by=tuple(s.graph_version for s in submaps),
    )  # fmt: skip


def heard(bus: Bus, held: list[Submap], told: list[TreeList], trees: int) -> bool:
    """Tell what the mapper holds, each second as it does, until a list of so many trees comes."""
    for _ in range(90):
        bus.publish(MAP_INDEX, index(held))
        if until(lambda: bool(told) and len(told[-1].trees) == trees, 1.0, bus):
            return True
    return False


def places(told: TreeList) -> dict[int, tuple[float, float]]:
    return {t.id: (round(t.x_m, 1), round(t.y_m, 1)) for t in told.trees}


def test_a_killed_detector_calls_the_trees_as_before(routed: System) -> None:
    held = [submap_of(np.concatenate([ground(5.0), tree(FAR)]), 1)]
    process = start(routed)
    told: list[TreeList] = []
    with routed.bus() as bus:
        bus.answer_state(MAP_CLOUD, lambda: list(held))
        bus.subscribe(TREES_LIST, told.append)
        assert heard(bus, held, told, 1), routed.said("detector")
        held.append(submap_of(tree(NEAR), 2))
        bus.publish(MAP_CLOUD, held[-1])
        assert heard(bus, held, told, 2), routed.said("detector")
        process.kill()
        process.wait()
        until(lambda: False, 0.5, bus)  # its last words arrive
        before = told[-1]
        assert places(before) == {1: FAR, 2: NEAR}
        told.clear()
        start(routed)
        assert heard(bus, held, told, 2), routed.said("detector")
    assert [places(t) for t in told] == [{1: FAR, 2: NEAR}] * len(told), "not even for a moment is one called otherwise"
    assert told[0].version > before.version
