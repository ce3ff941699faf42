"""The map over the real bus: late joiners and lossy ones end with the same, and it outlives the mapper's process."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from schemas.camera import Intrinsics
from schemas.mapping import GroundPatch, MapIndex, Submap, SubmapsWanted
from schemas.slam import Graph, GraphNode, Keyframe
from schemas.topics import MAP_CLOUD, MAP_GROUND, MAP_INDEX, SLAM_GRAPH, SLAM_KEYFRAME
from services.camera.codecs import encode_depth
from services.common.bus import Bus
from services.common.geometry import level_camera, to_transform
from services.detector.map_store import MapStore
from tests.process.conftest import ROOT, HealthWatch, System, until

K = Intrinsics(width=160, height=120, fx=125.0, fy=125.0, cx=79.5, cy=59.5, depth_scale=1000.0)
KEYFRAMES = 10


def keyframe(number: int) -> Keyframe:
    v = np.arange(120)[:, None] * np.ones((1, 160))
    wall = 4.0 + 0.05 * number
    seen = np.where(v > 70, np.minimum(1.5 * 125.0 / np.maximum(v - 59.5, 1.0), wall), wall)
    return Keyframe(
        keyframe_id=number, stamp_ns=number, map_id="m1", graph_version=1, T_map_camera=to_transform(where(number)),
        intrinsics=K, depth_encoding="png", depth=encode_depth(np.round(1000 * seen).astype(np.uint16), "png"),
    )  # fmt: skip


def where(number: int, shift_m: float = 0.0) -> np.ndarray:
    return level_camera([0.6 * number + shift_m, 0.0, 1.5], 0.3 * number)


def graph(version: int, shift_m: float = 0.0) -> Graph:
    nodes = tuple(GraphNode(keyframe_id=k, T_map_camera=to_transform(where(k, shift_m))) for k in range(KEYFRAMES))
    return Graph(
        stamp_ns=0, map_id="m1", version=version, reset_counter=0, reason="loop", nodes=nodes, up_sigma_rad=0.0
    )


@dataclass
class Follower:
    """Keeps the map as the detector does; ``deaf``: loses every second delta."""

    bus: Bus
    deaf: bool = False
    store: MapStore = field(default_factory=MapStore)
    heard: int = 0
    asked: int = 0
    wants: bool = False

    def __post_init__(self) -> None:
        self.bus.subscribe(MAP_CLOUD, self._on_submap)
        self.bus.subscribe(MAP_INDEX, self._on_index)

    def _on_submap(self, submap: Submap) -> None:
        self.heard += 1
        if self.deaf and self.heard % 2:
            return
        if not self.store.map_id:
            self.store.clear(submap.map_id)
        self.store.take(submap)

    def _on_index(self, index: MapIndex) -> None:
        if not self.store.map_id:
            self.store.clear(index.map_id)
        self.wants |= self.store.lacks(index, time.monotonic_ns())

    def whole(self) -> list[Submap]:
        return sorted(self.bus.ask(MAP_CLOUD, None, Submap, 3.0), key=lambda s: s.submap_id)

    def settle(self) -> None:
        """Ask when something is missing; never from within a handler."""
        if self.wants:
            self.wants = False
            self.asked += 1
            missing = self.store.missing()
            wanted = SubmapsWanted(map_id=self.store.map_id, submap_ids=tuple(missing))
            replies = self.bus.ask(MAP_CLOUD, wanted, Submap, 3.0)
            assert {submap.submap_id for submap in replies} <= set(missing), "nothing but what was asked for"
            for submap in replies:
                self.store.take(submap)


def placed(submaps: list[Submap]) -> np.ndarray:
    clouds = [s.points_m @ s.T_map_submap[:3, :3].T + s.T_map_submap[:3, 3] for s in submaps]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    return points[np.lexsort(np.round(points, 4).T)]


def agree(follower: Follower) -> bool:
    follower.settle()
    points = follower.store.assemble()[0]
    truth = placed(follower.whole())
    if len(points) != len(truth) or len(points) == 0:
        return False
    mine = points[np.lexsort(np.round(points, 4).T)]
    return bool(np.abs(np.sort(mine, axis=0) - np.sort(truth, axis=0)).max() < 1e-4)


@dataclass
class Rig:
    system: System
    state: Path

    def start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.process.map_nodes", str(self.system.port), str(self.state)]
        with self.system.log("mapper").open("ab") as log:
            process = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)
        self.system.processes.append(process)
        return process


@pytest.fixture
def rig(routed: System, tmp_path: Path) -> Rig:
    return Rig(routed, tmp_path / "state")


def up(bus: Bus) -> bool:
    return until(lambda: "mapper" in bus.live_services(0.2), timeout_s=90.0)


def speak(bus: Bus, *, shift_m: float = 0.0, version: int = 2) -> None:
    """Say what slam says over a walk and a loop closure."""
    for number in range(KEYFRAMES):
        bus.publish(SLAM_KEYFRAME, keyframe(number))
        time.sleep(0.02)
    bus.publish(SLAM_GRAPH, graph(version, shift_m))


def test_late_and_lossy_consumers_end_with_the_same_map(rig: Rig) -> None:
    rig.start()
    with rig.system.bus() as slam, rig.system.bus() as early, rig.system.bus() as lossy:
        first, second = Follower(early), Follower(lossy, deaf=True)
        assert up(slam), rig.system.said("mapper")
        speak(slam, shift_m=0.3)
        assert until(lambda: agree(first), bus=early, timeout_s=20.0), rig.system.said("mapper")
        assert until(lambda: agree(second), bus=lossy, timeout_s=40.0)
        assert second.asked >= 1
        with rig.system.bus() as late:
            third = Follower(late)
            assert until(lambda: agree(third), bus=late, timeout_s=20.0)
            assert set(third.store.poses()) == set(first.store.poses())
            assert sum(len(p.cells) for p in late.ask(MAP_GROUND, None, GroundPatch, 3.0)) > 20


def test_the_map_outlives_the_mapper(rig: Rig) -> None:
    process = rig.start()
    with rig.system.bus() as slam, rig.system.bus() as bus:
        follower, health = Follower(bus), HealthWatch(bus)
        assert up(slam), rig.system.said("mapper")
        speak(slam, shift_m=0.3)
        assert until(lambda: agree(follower), bus=bus, timeout_s=20.0)
        assert until(lambda: health.counter("mapper", "maps_saved") >= 1, bus=bus, timeout_s=20.0)
        time.sleep(1.5)
        before = placed(follower.whole())
        process.kill()
        process.wait()
        health.latest.clear()
        rig.start()
        assert until(lambda: health.counter("mapper", "submaps_restored") > 0, bus=bus, timeout_s=60.0)
        assert until(lambda: agree(follower), bus=bus, timeout_s=40.0)
        after = placed(follower.whole())
        assert len(after) >= len(before) > 10_000, "nothing that was saved is lost"


def test_a_damaged_file_is_set_aside_and_the_mapper_lives(rig: Rig) -> None:
    rig.state.mkdir()
    (rig.state / "map-uav1.tdmap").write_bytes(b"treedock map\nand then nothing of sense")
    rig.start()
    with rig.system.bus() as bus:
        health = HealthWatch(bus)
        assert up(bus), rig.system.said("mapper")
        assert until(lambda: health.counter("mapper", "bad_map_files") == 1, bus=bus)
        assert (rig.state / "map-uav1.tdmap.bad").exists()
        assert "map-uav1.tdmap" in rig.system.said("mapper")
        assert "Traceback" not in rig.system.said("mapper")
        speak(bus)
        assert until(lambda: health.counter("mapper", "maps_saved") >= 1, bus=bus, timeout_s=20.0)
