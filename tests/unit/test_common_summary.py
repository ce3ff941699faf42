"""The last lines of a run: which found tree stands for which true one."""

from __future__ import annotations

import io
from typing import Any

from rich.console import Console

from schemas.health import Health
from schemas.simulation import SimTruth, TrueTree
from schemas.slam import Transform
from schemas.trees import Tree, TreeList
from services.cli.summary import closing_line, pair, tree_table
from services.cli.watch import Watch


def tree(number: int, x_m: float, *, suitable: bool = True) -> Tree:
    return Tree(
        id=number, x_m=x_m, y_m=0.0, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=0.1, radius_height_m=1.3,
        height_seen_m=2.0, sigma_xy_m=0.01, sigma_radius_m=0.01, arc_rad=2.0, confidence=0.8, observations=3,
        suitable=suitable,
    )  # fmt: skip


def true(x_m: float, *, suitable: bool = True, fair: bool = True) -> TrueTree:
    return TrueTree(x_m=x_m, y_m=0.0, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=0.1, suitable=suitable, fair=fair)


def test_nearest_pairs_come_first_and_far_ones_never() -> None:
    assert pair((tree(1, 0.0), tree(2, 0.3)), (true(0.25), true(-0.1))) == {1: 0, 0: 1}
    assert pair((tree(1, 0.0),), (true(0.6),)) == {}
    assert pair((tree(1, 0.0), tree(2, 0.1)), (true(0.08),)) == {1: 0}


def test_the_table_shows_the_found_beside_the_true_and_the_missed() -> None:
    trees = TreeList(stamp_ns=0, map_id="m", version=1, graph_version=1, trees=(tree(1, 2.0), tree(2, 9.0)))
    still = Transform(position_m=(0.0, 0.0, 0.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0))
    truth = SimTruth(
        stamp_ns=0, seq=0, scene="multi-03", T_map_camera=still, touched=0, clearance_m=1.0,
        trees=(true(2.05), true(5.0), true(7.0, fair=False)),
    )  # fmt: skip
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(tree_table(trees, truth))
    text = console.export_text()
    assert "multi-03" in text
    rows = [line.split() for line in text.splitlines()]
    assert any(row[:1] == ["1"] and row[-1:] == ["5.0"] for row in rows)
    assert any(row[:1] == ["2"] and "none" in row for row in rows)
    assert [row for row in rows if row[:1] == ["missed"]] == [["missed", "5.00", "0.00", "10.0"]]


def test_the_closing_line_counts() -> None:
    values: dict[str, Any] = {
        "trees": [tree(1, 0.0).model_dump(), tree(2, 1.0, suitable=False).model_dump()],
        "truth": {"suitable": 2, "found": 1, "false": 0}, "frames": 40, "duration_s": 12.3,
        "restarts": {"slam": 1}, "dropped": {"slam": 3, "preview": 2, "camera": 1},
        "frames_left_out": {"slam": 3, "preview": 1},
    }  # fmt: skip
    assert closing_line(values) == (
        "2 trees found, 1 suitable; of 2 true suitable ones 1 found, 0 false; 40 frames in 12 s, 1 restarts; "
        "frames left out: slam 3, preview 1; 2 other samples dropped"
    )
    assert closing_line({**values, "trees": values["trees"][:1]}).startswith("1 tree found, 1 suitable")
    values |= {"restarts": {}, "dropped": {}, "frames_left_out": {}}
    assert closing_line(values).endswith("40 frames in 12 s")


def watch_of(**counters: dict[str, int]) -> Watch:
    made = object.__new__(Watch)
    made.health = {
        name: Health(service=name, stamp_ns=0, seq=0, state="ready", pid=1, uptime_s=1.0, counters=counts, rates_hz={},
                     work_ms={})
        for name, counts in counters.items()
    }  # fmt: skip
    return made


def test_a_frame_that_slam_left_out_is_counted_once_not_by_each_listener_of_its_poses() -> None:
    """As `treedock run --source mcap:...` was on a busy machine: 448 frames became 4155 dropped samples."""
    gap = {"dropped.slam/pose": 448}
    watch = watch_of(
        camera={"dropped_bad_frame": 1, "frames": 845},
        slam={"dropped.camera/rgbd": 447, "dropped_bad_frames": 2, "frames": 398},
        refiner=gap | {"dropped.camera/rgbd": 145}, detector=gap | {"dropped.trees/target": 145, "dropped.map/cloud": 6},
        station=gap | {"dropped.trees/target": 145}, preview=gap | {"dropped.slam/pose": 460}, navigator={},
    )  # fmt: skip
    assert watch.frames_left_out() == {"camera": 1, "refiner": 144, "slam": 448}
    assert watch.dropped() == {"camera": 1, "detector": 6, "preview": 11, "refiner": 144, "slam": 448}


def test_what_a_service_loses_by_itself_is_its_own() -> None:
    watch = watch_of(slam={}, recorder={"dropped_slow_disk": 7}, station={"dropped.slam/pose": 5})
    assert watch.frames_left_out() == {}
    assert watch.dropped() == {"recorder": 7, "station": 5}
