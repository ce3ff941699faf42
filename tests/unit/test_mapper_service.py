from __future__ import annotations

import numpy as np
import pytest

from schemas.camera import Intrinsics
from schemas.mapping import Submap, SubmapsWanted
from schemas.sketch import SubmapSketch
from schemas.slam import Graph, GraphNode, Keyframe
from schemas.topics import MAP_CLOUD, MAP_SKETCH, SLAM_GRAPH, SLAM_KEYFRAME
from services.camera.codecs import encode_depth
from services.common.config import TreedockConfig
from services.common.geometry import inverse, level_camera, to_transform
from services.common.memory import Hub
from services.mapper.cloud import KeyframeCloud
from services.mapper.config import MapperConfig
from services.mapper.dense_map import DenseMap
from services.mapper.service import MapperService, build

K = Intrinsics(width=160, height=120, fx=125.0, fy=125.0, cx=79.5, cy=59.5, depth_scale=1000.0)


def _keyframe(
    keyframe_id: int, T: np.ndarray, depth_m: float = 2.0, map_id: str = "m1", depth: bytes | None = None
) -> Keyframe:
    raw = np.full((120, 160), round(1000 * depth_m), dtype=np.uint16)
    return Keyframe(
        keyframe_id=keyframe_id, stamp_ns=keyframe_id, map_id=map_id, graph_version=1, T_map_camera=to_transform(T),
        intrinsics=K, depth_encoding="png", depth=encode_depth(raw, "png") if depth is None else depth,
    )  # fmt: skip


def _graph(version: int, poses: dict[int, np.ndarray], map_id: str = "m1") -> Graph:
    nodes = tuple(GraphNode(keyframe_id=k, T_map_camera=to_transform(T)) for k, T in poses.items())
    return Graph(
        stamp_ns=0, map_id=map_id, version=version, reset_counter=0, reason="loop", nodes=nodes, up_sigma_rad=0.0
    )


class _Listener:
    def __init__(self) -> None:
        self.hub = Hub(TreedockConfig())
        self.mapper: MapperService = build(self.hub.context("mapper"))
        self.heard: list[Submap] = []
        self.slam = self.hub.context("slam")
        self.hub.context("detector").on(MAP_CLOUD, self.heard.append)

    def send(self, message: Keyframe | Graph) -> list[Submap]:
        self.heard.clear()
        self.slam.publish(SLAM_KEYFRAME if isinstance(message, Keyframe) else SLAM_GRAPH, message)
        self.hub.run()
        return list(self.heard)


AHEAD = level_camera([0.0, 0.0, 1.5], 0.0)


def test_a_keyframe_becomes_a_submap_in_its_own_frame() -> None:
    system = _Listener()
    (submap,) = system.send(_keyframe(7, AHEAD))
    assert submap.submap_id == 7
    assert submap.points_m[:, 2] == pytest.approx(2.0, abs=1e-3)
    assert Submap.from_bytes(submap.to_bytes()).points_m == pytest.approx(submap.points_m)
    cloud = system.mapper.cloud()
    assert cloud.points_m[:, 0] == pytest.approx(2.0, abs=1e-3), "2 m ahead is along map x"
    assert len(cloud.points_m) == len(cloud.rgb) == len(submap.points_m)


def test_a_moved_submap_is_sent_without_points() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    moved_to = level_camera([0.5, 0.0, 1.5], 0.0)
    (submap,) = system.send(_graph(2, {1: moved_to}))
    assert len(submap.points_m) == 0
    assert submap.version == 1
    assert not submap.removed
    assert submap.T_map_submap == pytest.approx(moved_to)
    assert system.mapper.cloud().points_m[:, 0] == pytest.approx(2.5, abs=1e-3)
    assert system.send(_graph(3, {1: moved_to})) == [], "nothing moved: nothing to say"
    assert system.send(_graph(1, {1: AHEAD})) == [], "an older graph is ignored"


def test_looking_twice_costs_no_memory() -> None:
    system = _Listener()
    (first,) = system.send(_keyframe(1, AHEAD))
    again = system.send(_keyframe(2, AHEAD))
    assert sum(len(s.points_m) for s in again) < 0.05 * len(first.points_m)
    assert system.send(_keyframe(2, AHEAD)) == [], "the same keyframe again is no news"


def test_culled_keyframe_follows_its_neighbour() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    system.send(_keyframe(2, level_camera([0, 0, 1.5], 0.5)))
    before = system.mapper.map.submaps[2].T_map_submap.copy()
    system.send(_graph(2, {1: AHEAD}))
    assert system.mapper.map.submaps[2].T_map_submap == pytest.approx(before)
    moved = level_camera([0.0, 1.0, 1.5], 0.0)
    system.send(_graph(3, {1: moved}))
    assert system.mapper.map.submaps[2].T_map_submap == pytest.approx(moved @ inverse(AHEAD) @ before)


def test_a_graph_that_culls_a_keyframe_and_moves_the_others_moves_its_submap_too() -> None:
    """A closed loop is told with what its keyframe culled: both in one graph."""
    system = _Listener()
    at = {k: level_camera([0.3 * k, 0.0, 1.5], 0.4 * k) for k in range(1, 6)}
    for k, T in at.items():
        system.send(_keyframe(k, T))
    system.send(_graph(2, at))
    shifted = {k: level_camera([0.3 * k, 0.5, 1.5], 0.4 * k) for k in at if k != 3}
    system.send(_graph(3, shifted))
    assert {k: float(s.T_map_submap[1, 3]) for k, s in system.mapper.map.submaps.items()} == pytest.approx(
        dict.fromkeys(at, 0.5)
    )


def test_a_keyframe_that_was_culled_before_it_came_is_not_mapped_at_its_old_place() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    system.send(_graph(2, {1: level_camera([0.0, 0.5, 1.5], 0.0)}))
    assert system.send(_keyframe(2, AHEAD)) == [], "of graph 1, and graph 2 does not hold it"
    assert system.mapper._context.health.counters["culled_keyframes"] == 1
    late = _keyframe(3, AHEAD).model_copy(update={"graph_version": 3})
    assert [submap.submap_id for submap in system.send(late)] == [3], "its graph comes after it"


def test_a_slam_that_is_astray_by_kilometres_ends_no_mapper() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    far = level_camera([70_000.0, 0.0, 1.5], 0.0)
    assert system.send(_graph(2, {1: far})) == []
    assert system.send(_keyframe(2, far)) == []
    health = system.mapper._context.health
    assert health.counters["poses_astray"] == 2
    assert "70 km" in health.notes["slam"]
    assert system.mapper.map.submaps[1].T_map_submap == pytest.approx(AHEAD)
    system.send(_graph(3, {1: AHEAD}))
    assert "slam" not in health.notes


def test_a_new_map_withdraws_the_old() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    gone, new = system.send(_keyframe(1, AHEAD, map_id="m2"))
    assert gone.removed
    assert (gone.map_id, new.map_id) == ("m1", "m2")


def test_damaged_depth_is_counted_not_mapped() -> None:
    system = _Listener()
    assert system.send(_keyframe(1, AHEAD, depth=b"\x89PNG not really")) == []
    health = system.mapper._context.health
    assert health.counters["bad_keyframes"] == 1
    assert "keyframe 1" in health.notes["slam/keyframe"]
    system.send(_keyframe(2, AHEAD))
    assert health.notes == {}


def test_whole_map_answers_a_late_joiner() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    system.send(_keyframe(2, level_camera([0, 0, 1.5], 1.0)))
    late = system.hub.context("detector").ask(MAP_CLOUD, None, Submap, 1.0)
    assert [s.submap_id for s in late] == [1, 2]
    assert sum(len(s.points_m) for s in late) == len(system.mapper.cloud().points_m)


def test_who_misses_a_submap_gets_that_one_alone() -> None:
    system = _Listener()
    for number in (1, 2, 3):
        system.send(_keyframe(number, level_camera([0, 0, 1.5], 1.0 * number)))
    detector = system.hub.context("detector")

    def answer(map_id: str, *numbers: int) -> list[int]:
        wanted = SubmapsWanted(map_id=map_id, submap_ids=numbers)
        return [s.submap_id for s in detector.ask(MAP_CLOUD, wanted, Submap, 1.0)]

    assert answer("m1", 3, 1) == [3, 1]
    assert answer("m1", 2, 9) == [2], "one that is gone is no answer"
    assert answer("m0", 1) == [], "another map's are not here"


def test_the_radio_gets_a_sketch_of_each_submap_while_somebody_looks() -> None:
    system = _Listener()
    system.send(_keyframe(1, AHEAD))
    ground = system.hub.context("station")
    (late,) = ground.ask(MAP_SKETCH, None, SubmapSketch, 1.0)
    assert late.submap_id == 1
    assert late.points_cm[:, 2] == pytest.approx(200, abs=1)
    seen: list[SubmapSketch] = []
    ground.on(MAP_SKETCH, seen.append)
    (moved,) = system.send(_graph(2, {1: level_camera([0.5, 0.0, 1.5], 0.0)}))
    assert [s.moved for s in seen] == [True]
    assert seen[0].T_map_submap == pytest.approx(moved.T_map_submap)
    system.send(_keyframe(1, AHEAD, map_id="m2"))
    assert [(s.map_id, s.removed) for s in seen[1:]] == [("m1", True), ("m2", False)]


def _patch(z: float, n: int = 3000, seed: int = 0) -> KeyframeCloud:
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), np.full(n, z)], axis=1).astype(np.float32)
    return KeyframeCloud(points, np.zeros((n, 3), dtype=np.uint8))


def test_memory_stays_bounded() -> None:
    dense = DenseMap(MapperConfig(max_points=10_000))
    for k in range(12):
        dense.add(k, k, _patch(2.0, seed=k), level_camera([0.0, 3.0 * k, 1.5], 0.0))
        assert dense.size <= 10_000 + 3_000
    assert dense.submaps[0].version > 1, "the oldest was thinned and must be sent again"


def test_what_is_seen_from_nearer_gets_in() -> None:
    dense = DenseMap(MapperConfig())
    dense.add(0, 0, _patch(5.0, seed=1), level_camera([0, 0, 1.5], 0.0))
    dense.add(1, 1, _patch(1.5, seed=1), level_camera([3.5, 0, 1.5], 0.0))
    assert len(dense.submaps[1].points_m) > 0.9 * 3000


def test_registration_moves_a_cloud_within_its_keyframe_and_rides_on_it() -> None:
    hub = Hub(TreedockConfig(mapper=MapperConfig(register_clouds=True, registration_sigma_m=0.02)))
    mapper, slam = build(hub.context("mapper")), hub.context("slam")
    for number, x in enumerate((0.0, 0.0, 0.03)):  # the wall is 2 m from all three: the third is 3 cm off
        slam.publish(SLAM_KEYFRAME, _keyframe(number, level_camera([x, 0.02 * number, 1.5], 0.1 * number)))
        hub.run()
    health = mapper._context.health
    assert health.counters["registered"] + health.counters["not_registered"] == 3
    third = mapper.map.submaps[2]
    assert np.linalg.norm(third.T_anchor_submap[:3, 3]) < 0.1, "never far from where slam put it"
    before = third.T_map_submap.copy()
    lift = np.eye(4)
    lift[2, 3] = 1.0
    poses = {k: lift @ level_camera([x, 0.02 * k, 1.5], 0.1 * k) for k, x in enumerate((0.0, 0.0, 0.03))}
    slam.publish(SLAM_GRAPH, _graph(2, poses))
    hub.run()
    assert third.T_map_submap == pytest.approx(lift @ before)
