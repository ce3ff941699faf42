"""The simulator service in lockstep, over the bus in memory."""

from __future__ import annotations

import itertools
import math
from typing import cast

import numpy as np

from schemas.camera import RgbdFrame
from schemas.simulation import SimClock, SimTruth
from schemas.slam import Pose
from schemas.topics import SIM_CLOCK, SIM_RGBD, SIM_TRUTH, SLAM_POSE, TREES_TARGET
from schemas.trees import Target
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.memory import Hub
from services.simulator.config import PathConfig, SimulatorConfig
from services.simulator.lockstep import Lockstep
from services.simulator.scan import Scan

QUICK = PathConfig(rest_s=0.2, turn_rate_rad_s=2.0, speed_m_s=4.0, hold_s=0.2)
CONFIG = SimulatorConfig(scene="single-01", reduced=True, rate_hz=3.0, path=QUICK)


class Bench:
    """The simulator with stand-ins for slam and refiner."""

    def __init__(self, config: SimulatorConfig = CONFIG) -> None:
        self.hub = Hub(TreedockConfig())
        self.now_s = 0.0
        self.context = self.hub.context("simulator")
        self.frames: list[RgbdFrame] = []
        self.clocks: list[SimClock] = []
        self.truths: list[SimTruth] = []
        self.others = self.hub.context("others")
        self.answering = {"slam", "refiner"}
        self.others.on(SIM_RGBD, self._on_frame)
        self.others.on(SIM_CLOCK, self.clocks.append)
        self.others.on(SIM_TRUTH, self.truths.append)
        self.simulator = Scan(cast(Context, self.context), config, wall=lambda: self.now_s)

    def _on_frame(self, frame: RgbdFrame) -> None:
        self.frames.append(frame)
        if "slam" in self.answering:
            self.others.publish(SLAM_POSE, Pose(
                stamp_ns=frame.stamp_ns, seq=frame.seq, map_id="m", status="lost", T_map_camera=None, covariance=None,
                reset_counter=0, graph_version=0, keyframe_id=None, T_keyframe_camera=None, inliers=0,
                up_sigma_rad=0.0, processing_ms=1.0,
            ))  # fmt: skip
        if "refiner" in self.answering:
            nothing = dict.fromkeys(
                set(Target.model_fields) - {"stamp_ns", "seq", "map_id", "status", "measured", "note"}
            )
            target = {"stamp_ns": frame.stamp_ns, "seq": frame.seq, "map_id": "m", "status": "none", "measured": False}
            self.others.publish(TREES_TARGET, Target.model_validate(nothing | target))

    def tick(self, seconds: float) -> None:
        self.now_s += seconds
        self.simulator.tick()
        self.hub.run()


def test_a_whole_scan_in_lockstep() -> None:
    bench = Bench()
    bench.tick(0.0)
    assert bench.simulator.phase == "done"
    assert len(bench.frames) > 15
    stamps = [frame.stamp_ns for frame in bench.frames]
    assert all(b > a for a, b in itertools.pairwise(stamps))
    assert [frame.seq for frame in bench.frames] == list(range(len(stamps)))
    times = [clock.stamp_ns for clock in bench.clocks]
    assert times == sorted(times)
    assert max(np.diff(times)) <= 10_000_001
    assert bench.clocks[-1].phase == "done"
    frame = RgbdFrame.from_bytes(bench.frames[3].to_bytes())
    assert frame.render_scale == 0.5
    assert frame.accel_camera is not None
    assert len(frame.depth) == 640 * 480 * 2
    last = bench.truths[-1]
    assert last.touched == 0
    assert last.clearance_m > 0.25
    tree = last.trees[0]
    x, y, _ = last.T_map_camera.position_m
    assert 0.85 < math.hypot(tree.x_m - x, tree.y_m - y) < 1.15
    assert "lockstep" not in bench.context.health.notes


def test_time_waits_for_the_services_and_says_so() -> None:
    bench = Bench()
    bench.answering = {"slam"}
    bench.tick(0.0)
    assert len(bench.frames) == 1
    assert "waiting" in bench.context.health.notes["lockstep"]
    bench.tick(0.5)
    assert len(bench.frames) == 1  # too early to try again
    bench.tick(0.6)
    assert len(bench.frames) == 2
    assert bench.clocks[-1].phase == "waiting"
    positions = {truth.T_map_camera.position_m for truth in bench.truths}
    assert positions == {(0.0, 0.0, 0.0)}
    bench.answering = {"slam", "refiner"}
    bench.tick(1.1)
    assert bench.simulator.phase == "done"


def test_a_silent_service_holds_time_for_its_limit_only() -> None:
    bench = Bench()
    sent = bench._on_frame

    def mute_after_five(frame: RgbdFrame) -> None:
        if frame.seq == 5:
            bench.answering = {"slam"}
        sent(frame)

    bench.hub._handlers[SIM_RGBD.key(bench.hub.uav)] = [mute_after_five]
    bench.tick(0.0)
    assert len(bench.frames) == 6
    bench.tick(9.0)
    assert len(bench.frames) == 6
    bench.tick(1.5)
    assert len(bench.frames) == 7
    assert "refiner did not answer" in bench.context.health.notes["lockstep"]
    assert bench.context.health.counters["lockstep_timeouts"] == 1


def test_lockstep_takes_each_answer_once_and_for_its_frame() -> None:
    lockstep = Lockstep(("slam", "refiner"), 10.0)
    lockstep.sent(100, 0.0)
    assert not lockstep.answered("slam", 99)
    assert not lockstep.answered("slam", 100)
    assert not lockstep.answered("slam", 100)
    assert lockstep.overdue(5.0) == ()
    assert lockstep.overdue(10.5) == ("refiner",)
    assert lockstep.answered("refiner", 100)
    assert lockstep.overdue(20.0) == ()
