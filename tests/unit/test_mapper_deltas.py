"""Whoever misses deltas, or joins late, ends with the same map."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics
from schemas.mapping import GroundPatch, MapIndex, Submap, SubmapsWanted
from schemas.slam import Graph, GraphNode, Keyframe
from schemas.topics import MAP_CLOUD, MAP_GROUND, MAP_INDEX, SLAM_GRAPH, SLAM_KEYFRAME
from services.camera.codecs import encode_depth
from services.common.config import TreedockConfig
from services.common.geometry import level_camera, to_transform
from services.common.memory import Hub
from services.detector.map_store import MapStore
from services.mapper.service import MapperService, build

K = Intrinsics(width=80, height=60, fx=62.5, fy=62.5, cx=39.5, cy=29.5, depth_scale=1000.0)


class Consumer:
    """Keeps the map as the detector does; loses each delta with a probability."""

    def __init__(self, hub: Hub, loss: float, seed: int = 0) -> None:
        self.context = hub.context("detector")
        self.store = MapStore()
        self.asked = 0
        self._loss, self._rng = loss, np.random.default_rng(seed)
        self.context.on(MAP_CLOUD, self._on_submap)
        self.context.on(MAP_INDEX, self._on_index)

    def _on_submap(self, submap: Submap) -> None:
        if self._rng.random() < self._loss:
            return
        self._take(submap)

    def _take(self, submap: Submap) -> None:
        submap = Submap.from_bytes(submap.to_bytes())
        if submap.map_id != self.store.map_id:
            if submap.removed:
                return
            self.store.clear(submap.map_id)
        self.store.take(submap)

    def _on_index(self, index: MapIndex) -> None:
        if not self.store.map_id:
            self.store.clear(index.map_id)
        if self.store.lacks(index, self.context.clock.now_ns()):
            self.asked += 1
            wanted = SubmapsWanted(map_id=self.store.map_id, submap_ids=tuple(self.store.missing()))
            for submap in self.context.ask(MAP_CLOUD, wanted, Submap, 1.0):
                self._take(submap)


class World:
    """slam's side of the hub: keyframes along a walk, and graphs that move them."""

    def __init__(self) -> None:
        self.hub = Hub(TreedockConfig())
        self.mapper: MapperService = build(self.hub.context("mapper"))
        self.slam = self.hub.context("slam")
        self.poses: dict[int, np.ndarray] = {}
        self.version = 1
        self.now_ns = 0

    def keyframe(self, number: int, map_id: str = "m1") -> None:
        T = level_camera([0.6 * number, 0.0, 1.5], 0.3 * number)
        self.poses[number] = T
        v = np.arange(60)[:, None] * np.ones((1, 80))
        wall = 4.0 + 0.05 * number
        seen = np.where(v > 35, np.minimum(1.5 * 62.5 / np.maximum(v - 29.5, 1.0), wall), wall)
        raw = np.round(1000 * seen).astype(np.uint16)
        self.slam.publish(SLAM_KEYFRAME, Keyframe(
            keyframe_id=number, stamp_ns=self.now_ns, map_id=map_id, graph_version=self.version, T_map_camera=to_transform(T),
            intrinsics=K, depth_encoding="png", depth=encode_depth(raw, "png"),
        ))  # fmt: skip
        self._on()

    def graph(self, shift_m: float, map_id: str = "m1") -> None:
        self.version += 1
        for T in self.poses.values():
            T[:2, 3] += shift_m
        nodes = tuple(GraphNode(keyframe_id=k, T_map_camera=to_transform(T)) for k, T in self.poses.items())
        self.slam.publish(SLAM_GRAPH, Graph(
            stamp_ns=self.now_ns, map_id=map_id, version=self.version, reset_counter=0, reason="loop", nodes=nodes,
            up_sigma_rad=0.0,
        ))  # fmt: skip
        self._on()

    def rest(self, seconds: float = 70.0) -> None:
        for _ in range(int(seconds)):
            self._on()

    def _on(self) -> None:
        self.hub.run()
        self.now_ns += 1_000_000_000
        self.hub.advance_to(self.now_ns)


def same(store: MapStore, mapper: MapperService) -> None:
    points, _ = store.assemble()
    expected = mapper.cloud().points_m
    assert len(points) == len(expected) > 0
    order, wanted = np.lexsort(points.T), np.lexsort(expected.T)
    assert points[order] == pytest.approx(expected[wanted], abs=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_a_consumer_that_misses_half_of_the_deltas_ends_with_the_same_map(seed: int) -> None:
    world = World()
    consumer = Consumer(world.hub, loss=0.5, seed=seed)
    rng = np.random.default_rng(seed)
    for number in range(12):
        world.keyframe(number)
        if rng.random() < 0.4:
            world.graph(float(rng.choice([0.005, 0.2])))
    world.rest()
    same(consumer.store, world.mapper)
    assert consumer.asked >= 1


def test_a_consumer_that_misses_nothing_never_asks() -> None:
    world = World()
    consumer = Consumer(world.hub, loss=0.0)
    for number in range(8):
        world.keyframe(number)
    world.graph(0.3)
    world.rest(10)
    same(consumer.store, world.mapper)
    assert consumer.asked == 0


def test_a_late_joiner_gets_the_whole_without_any_change() -> None:
    world = World()
    for number in range(6):
        world.keyframe(number)
    world.graph(0.1)
    late = Consumer(world.hub, loss=0.0)
    world.rest(6)
    same(late.store, world.mapper)


def test_a_missed_withdrawal_and_a_new_map() -> None:
    world = World()
    consumer = Consumer(world.hub, loss=0.0)
    for number in range(3):
        world.keyframe(number)
    world.keyframe(5, map_id="m2")
    world.rest(12)
    same(consumer.store, world.mapper)
    assert consumer.store.map_id == "m2"


def test_a_mapper_that_begins_again_is_not_taken_for_the_old_one() -> None:
    world = World()
    consumer = Consumer(world.hub, loss=0.0)
    for number in range(5):
        world.keyframe(number)
    world.hub._handlers.pop(SLAM_KEYFRAME.key("uav1"))  # the old mapper is gone
    world.hub._handlers.pop(SLAM_GRAPH.key("uav1"))
    world.hub._timers.clear()
    world.mapper = build(world.hub.context("mapper"))
    for number in (3, 4, 6):
        world.keyframe(number)
    world.rest(40)
    same(consumer.store, world.mapper)
    assert set(consumer.store.poses()) == {3, 4, 6}


def test_the_ground_comes_as_patches_and_as_a_whole() -> None:
    world = World()
    cells: dict[tuple[int, int], float] = {}
    sequence = []

    def take(patch: GroundPatch) -> None:
        sequence.append(patch.sequence)
        for gone in patch.gone:
            del cells[gone]
        cells.update({(c.column, c.row): c.height_m for c in patch.cells})

    world.hub.context("recorder").on(MAP_GROUND, take)
    for number in range(6):
        world.keyframe(number)
    world.graph(0.4)
    world.rest(3)
    whole = world.hub.context("late").ask(MAP_GROUND, None, GroundPatch, 1.0)
    assert {(c.column, c.row): c.height_m for patch in whole for c in patch.cells} == cells
    assert sequence == list(range(1, len(sequence) + 1))
    assert whole[0].sequence == sequence[-1]
    heights = np.array(list(cells.values()))
    assert heights == pytest.approx(0.0, abs=0.1), "the wall is no ground; at its foot the cell holds both"
    assert np.median(heights) == pytest.approx(0.0, abs=0.02)
    assert len(cells) > 20
