"""The detector in memory, fed as the mapper feeds it."""

from __future__ import annotations

from itertools import islice

import numpy as np

from schemas.codec import Wire
from schemas.mapping import MapIndex, Submap, SubmapsWanted
from schemas.topics import MAP_CLOUD, MAP_INDEX, TREES_LIST
from schemas.trees import TreeList
from services.common.config import TreedockConfig
from services.common.geometry import level_camera
from services.common.memory import Hub
from services.detector.config import DetectorServiceConfig
from services.detector.service import DetectorService, build
from tests.unit.detector_clouds import Floats

EYE = level_camera([0.0, 0.0, 1.5], 0.0)


def submap_of(
    points_map: Floats,
    submap_id: int = 1,
    version: int = 1,
    map_id: str = "m1",
    T: Floats = EYE,
    graph_version: int = 3,
) -> Submap:
    local = (points_map - T[:3, 3]) @ T[:3, :3]
    n = len(local)
    return Submap(
        map_id=map_id, submap_id=submap_id, version=version, graph_version=graph_version, stamp_ns=0, T_map_submap=T,
        points_m=local.astype(np.float32), view=np.zeros(n, dtype=np.uint16), origins_m=np.zeros((1, 3), dtype=np.float32),
        colour=np.zeros((0, 3), dtype=np.uint8),
    )  # fmt: skip


def moved(submap: Submap, T: Floats) -> Submap:
    none = np.zeros((0, 3), dtype=np.float32)
    return Submap(
        map_id=submap.map_id, submap_id=submap.submap_id, version=submap.version, graph_version=4, stamp_ns=0, T_map_submap=T,
        points_m=none, view=np.zeros(0, dtype=np.uint16), origins_m=none, colour=np.zeros((0, 3), dtype=np.uint8),
    )  # fmt: skip


class System:
    """A detector, and the lists that it published; ``whole`` is what the mapper answers with."""

    def __init__(self, state_dir: str = "auto", now_ns: int = 0) -> None:
        self.hub = Hub(TreedockConfig(detector=DetectorServiceConfig(state_dir=state_dir)))
        self.hub.clock.set_ns(now_ns)
        self.detector: DetectorService = build(self.hub.context("detector"))
        self.lists: list[TreeList] = []
        self.mapper = self.hub.context("mapper")
        self.whole: list[Submap] = []
        self.at_once = 1000
        """Submaps that the mapper gets sent before whoever asked gives up."""
        self.mapper.answer_state(MAP_CLOUD, lambda: list(self.whole), SubmapsWanted, self._wanted)
        self.hub.context("navigator").on(TREES_LIST, self.lists.append)

    def _wanted(self, wanted: SubmapsWanted) -> list[Wire]:
        chosen = (s for s in self.whole if s.map_id == wanted.map_id and s.submap_id in wanted.submap_ids)
        return list(islice(chosen, self.at_once))

    def send(self, *submaps: Submap) -> None:
        for submap in submaps:
            self.mapper.publish(MAP_CLOUD, submap)
        self.rest()

    def tell_index(self, *submaps: Submap, graph_version: int = 3, epoch: int = 1) -> None:
        """Say what the mapper holds; another ``epoch`` is another run of the mapper."""
        ids, versions = tuple(s.submap_id for s in submaps), tuple(s.version for s in submaps)
        index = MapIndex(
            stamp_ns=self.hub.clock.now_ns(), map_id=submaps[0].map_id, epoch=epoch, graph_version=graph_version,
            submap_ids=ids, versions=versions, placed_by=tuple(s.graph_version for s in submaps), ground_sequence=0,
        )  # fmt: skip
        self.mapper.publish(MAP_INDEX, index)
        self.rest()

    def rest(self, seconds: float = 0.5) -> None:
        """Let time go on."""
        self.hub.run()
        self.hub.advance_to(self.hub.clock.now_ns() + round(seconds * 1e9))
