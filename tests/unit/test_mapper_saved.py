"""The map survives a restart, and a damaged file never does harm."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.files import write_parts
from services.common.geometry import level_camera, pose, rotation_z
from services.common.memory import Hub
from services.common.state import state_folder
from services.mapper.config import MapperConfig
from services.mapper.dense_map import MapSubmap
from services.mapper.keeper import MapKeeper
from services.mapper.saved_map import SavedMap, SavedMapError, pack, unpack
from tests.unit.test_mapper_deltas import Consumer, World, same


def saved(count: int = 3, seed: int = 0) -> SavedMap:
    rng = np.random.default_rng(seed)
    submaps = [
        MapSubmap(
            k, 10 * k, rng.normal(size=(50 + k, 3)).astype(np.float32), rng.integers(0, 256, (50 + k, 3), dtype=np.uint8),
            level_camera([k, 0.0, 1.5], 0.1 * k), version=k + 1, anchor_id=0,
            T_anchor_submap=pose(rotation_z(0.1), [0.1 * k, 0.0, 0.0]),
        )
        for k in range(count)
    ]  # fmt: skip
    return SavedMap("map-1", 17, submaps)


def test_a_map_comes_back_as_it_was() -> None:
    before = saved()
    after = unpack(b"".join(pack(before)))
    assert (after.map_id, after.graph_version) == ("map-1", 17)
    for a, b in zip(before.submaps, after.submaps, strict=True):
        assert (a.submap_id, a.stamp_ns, a.version, a.anchor_id) == (b.submap_id, b.stamp_ns, b.version, b.anchor_id)
        assert (a.points_m == b.points_m).all()
        assert (a.rgb == b.rgb).all()
        assert (a.T_map_submap == b.T_map_submap).all()
        assert (a.T_anchor_submap == b.T_anchor_submap).all()
        assert b.points_m.flags.writeable, "read-only arrays would have every kernel compiled again"


GOOD = b"".join(pack(saved()))


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(GOOD) - 1), st.integers(1, 255))
def test_any_changed_byte_is_noticed(at: int, by: int) -> None:
    damaged = bytearray(GOOD)
    damaged[at] = (damaged[at] + by) % 256
    with pytest.raises(SavedMapError):
        unpack(bytes(damaged))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(GOOD) - 1))
def test_a_file_cut_anywhere_is_refused(size: int) -> None:
    with pytest.raises(SavedMapError):
        unpack(GOOD[:size])


def test_a_failed_write_leaves_the_old_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "map-uav1.tdmap"
    write_parts(file, pack(saved(2)))

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space"):
        write_parts(file, pack(saved(3)))
    assert len(unpack(file.read_bytes()).submaps) == 2


def test_a_disk_that_refuses_is_told_and_counted(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    counts: list[str] = []
    notes: dict[str, str] = {}
    keeper = MapKeeper(tmp_path / "file" / "map.tdmap", counts.append, notes.__setitem__)
    keeper.finish(lambda: keeper.save("m", 1, saved().submaps))
    assert counts == ["map_save_errors"]
    assert "map.tdmap: cannot be written" in notes["map file"]


def test_where_state_is_kept() -> None:
    environment = {"STATE_DIRECTORY": "/var/lib/treedock:/x", "XDG_STATE_HOME": "/h"}
    assert state_folder("auto", "uav1", environment, simulated=False) == Path("/var/lib/treedock")
    environment.pop("STATE_DIRECTORY")
    assert state_folder("auto", "uav1", environment, simulated=False) == Path("/h/treedock/uav1")
    assert state_folder("auto", "uav1", environment, simulated=True) is None
    assert state_folder("off", "uav1", environment, simulated=False) is None
    assert state_folder("/here", "uav1", environment, simulated=True) == Path("/here")


def kept_world(folder: Path) -> World:
    world = World()
    config = TreedockConfig(mapper=MapperConfig(state_dir=str(folder), save_s=1.0))
    world.restart = lambda: start(world, config)  # type: ignore[attr-defined]
    start(world, config)
    return world


def start(world: World, config: TreedockConfig) -> None:
    """Begin anew with a fresh hub: everything but the disk is forgotten."""
    from services.mapper.service import build

    world.hub = Hub(config)
    world.hub.clock.set_ns(world.now_ns)
    world.mapper = build(world.hub.context("mapper"))
    world.slam = world.hub.context("slam")


def test_a_restarted_mapper_goes_on_with_its_map(tmp_path: Path) -> None:
    world = ended_world(tmp_path, 6)
    before = world.mapper.cloud()
    start(world, world.hub.config)
    consumer = Consumer(world.hub, loss=0.0)
    assert len(world.mapper.cloud().points_m) == 0, "not before slam has shown that it works on the same map"
    world.graph(0.0)
    after = world.mapper.cloud()
    assert (after.points_m == before.points_m).all()
    assert (after.rgb == before.rgb).all()
    world.rest(7)
    same(consumer.store, world.mapper)
    world.keyframe(3)
    assert world.mapper._context.health.counters["repeated_keyframes"] == 1
    world.keyframe(6)
    assert world.mapper.map.size >= len(before.points_m)


def test_keyframes_that_come_before_the_graph_wait_for_it(tmp_path: Path) -> None:
    world = kept_world(tmp_path)
    for number in range(6):
        world.keyframe(number)
    world.graph(0.2)
    world.hub.stop()
    before, stamps = world.mapper.cloud(), {k: s.stamp_ns for k, s in world.mapper.map.submaps.items()}
    for graph_comes in (True, False):
        start(world, world.hub.config)
        shape, world.poses, now_ns = world.poses, {}, world.now_ns
        for number in range(6):
            world.now_ns = stamps[number]
            world.keyframe(number)
        world.poses, world.now_ns = shape, now_ns
        assert world.mapper.map.size == 0
        if graph_comes:
            world.graph(0.0)
            assert (world.mapper.cloud().points_m == before.points_m).all()
            assert world.mapper._context.health.counters["repeated_keyframes"] == 6
        else:
            world.rest(5)
            assert world.mapper.map.size > 0, "without a graph they wait no longer"
            assert "submaps_restored" not in world.mapper._context.health.counters


def ended_world(folder: Path, keyframes: int) -> World:
    """Return a world whose mapper has ended, its map of so many keyframes on disk."""
    world = kept_world(folder)
    for number in range(keyframes):
        world.keyframe(number)
    world.graph(0.2)
    world.rest(3)
    world.hub.stop()
    _written(world)
    return world


def test_the_saved_map_waits_for_a_graph_that_comes_late(tmp_path: Path) -> None:
    """The bus sends the last keyframes again, and slam, at rest, makes no graph for a while."""
    world = ended_world(tmp_path, 6)
    stamp_ns = world.mapper.map.submaps[5].stamp_ns
    start(world, world.hub.config)
    shape, world.poses, now_ns = world.poses, {}, world.now_ns
    world.now_ns = stamp_ns
    world.keyframe(5)
    world.poses, world.now_ns = shape, now_ns
    world.rest(6)
    assert list(world.mapper.map.submaps) == [5]
    world.graph(0.0)
    assert sorted(world.mapper.map.submaps) == [0, 1, 2, 3, 4, 5]


def test_a_map_that_slam_has_thinned_meanwhile_is_taken_up(tmp_path: Path) -> None:
    world = ended_world(tmp_path, 12)
    start(world, world.hub.config)
    world.poses = {number: pose for number, pose in world.poses.items() if number in (2, 6, 11)}
    world.graph(0.0)
    assert len(world.mapper.map.submaps) == 12, "three of its keyframes place them all"


def _written(world: World) -> None:
    """Wait for the disk: on a busy machine the last writing comes too late for the service's half second."""
    keeper = world.mapper._keeper
    assert keeper is not None
    for _ in range(2):
        if keeper._writer is not None:
            keeper._writer.join(30.0)
        world.mapper._save()


def test_another_map_or_an_earlier_slam_does_not_get_it(tmp_path: Path) -> None:
    for change in ("name", "begun again"):
        world = kept_world(tmp_path)
        for number in range(4):
            world.keyframe(number)
        for _ in range(5):
            world.graph(0.0)
        world.hub.stop()
        _written(world)
        start(world, world.hub.config)
        if change == "begun again":
            world.version = 0
        world.graph(0.0, map_id="m2" if change == "name" else "m1")
        assert world.mapper.map.size == 0, change


def test_a_corrupt_file_is_named_counted_and_set_aside(tmp_path: Path) -> None:
    file = tmp_path / "map-uav1.tdmap"
    file.write_bytes(GOOD[:-20])
    world = kept_world(tmp_path)
    health = world.mapper._context.health
    assert health.counters["bad_map_files"] == 1
    assert "map-uav1.tdmap" in health.notes["map file"]
    assert "set aside as map-uav1.tdmap.bad" in health.notes["map file"]
    assert not file.exists()
    assert (tmp_path / "map-uav1.tdmap.bad").read_bytes() == GOOD[:-20]
    world.keyframe(0)
    world.rest(3)
    world.hub.stop()
    assert unpack(file.read_bytes()).submaps
    assert health.notes == {}


def test_off_line_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    world = World()
    world.keyframe(0)
    world.rest(20)
    world.hub.stop()
    assert list(tmp_path.rglob("*")) == []


def test_a_run_keeps_its_map_in_its_own_folder_and_begins_without_one(tmp_path: Path) -> None:
    from services.cli.run_plan import with_state

    folder = tmp_path / "state"
    folder.mkdir()
    (folder / "map-uav1.tdmap").write_bytes(b"of the last run")
    kept = with_state(TreedockConfig(), folder)
    assert kept.mapper.state_dir == kept.detector.state_dir == str(folder)
    assert not folder.exists()
    off = TreedockConfig(mapper=MapperConfig(state_dir="off"))
    assert with_state(off, folder).mapper.state_dir == "off"
