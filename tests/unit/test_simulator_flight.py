"""Whom simulated time waits for, and the flying simulator with stand-ins for those who fly it."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from schemas.camera import RgbdFrame
from schemas.navigation import Guidance
from schemas.simulation import SimClock, SimTruth
from schemas.slam import Pose
from schemas.topics import (
    MISSION_GUIDANCE,
    SECOND_POSE,
    SIM_CLOCK,
    SIM_RGBD,
    SIM_SECOND,
    SIM_TRUTH,
    SLAM_POSE,
    TREES_TARGET,
    VEHICLE_STATE,
)
from schemas.trees import Target
from schemas.vehicle import VehicleState
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.geometry import level_camera
from services.common.memory import Hub
from services.fusion.config import FusionConfig, SecondCameraConfig
from services.simulator.camera import SimulatedCamera
from services.simulator.catalogue import scene_by_name
from services.simulator.config import FlightConfig, SensorConfig, SimulatorConfig
from services.simulator.flight import Flight
from services.simulator.followers import Follower, Followers
from services.simulator.px4.config import Px4Config
from services.simulator.px4.modes import NavState
from services.simulator.px4.simulated import SimulatedPx4
from services.simulator.touch import Touches
from services.simulator.world import World


class Lives:
    def __init__(self, *names: str) -> None:
        self.names = set(names)

    def __call__(self, name: str) -> bool:
        return name in self.names


def followers(lives: Lives) -> Followers:
    both = [Follower("slam", ("camera",)), Follower("refiner", ("camera", "slam"))]
    return Followers(both, lives, 2.0)


SEES = ("slam", "refiner")


def test_nobody_is_waited_for_before_the_first_answer() -> None:
    f = followers(Lives("camera", "slam", "refiner"))
    assert not f.waits(SEES, 100, 0.0)
    f.answered("slam", 100)
    f.answered("refiner", 100)
    assert f.complete
    assert f.waits(SEES, 200, 0.1)
    f.answered("slam", 200)
    assert f.waits(SEES, 200, 0.2)
    f.answered("refiner", 200)
    assert not f.waits(SEES, 200, 0.3)


def test_the_dead_are_not_waited_for_nor_those_who_need_them() -> None:
    lives = Lives("camera", "slam", "refiner")
    f = followers(lives)
    for name in SEES:
        f.answered(name, 100)
    lives.names.discard("slam")
    assert not f.waits(SEES, 200, 0.0)  # the refiner answers slam's poses
    assert set(f.missing) == {"slam", "refiner"}
    lives.names.add("slam")
    assert not f.waits(("slam",), 300, 0.1)  # back to life, but it may not have heard this frame
    f.answered("slam", 300)
    assert f.waits(SEES, 400, 0.2)


def test_a_dead_camera_blinds_both() -> None:
    lives = Lives("camera", "slam", "refiner")
    f = followers(lives)
    for name in SEES:
        f.answered(name, 100)
    lives.names.discard("camera")
    assert not f.waits(SEES, 200, 0.0)


def test_the_hung_are_waited_for_up_to_the_limit_and_again_after_an_answer() -> None:
    f = followers(Lives("camera", "slam", "refiner"))
    for name in SEES:
        f.answered(name, 100)
    assert f.waits(SEES, 200, 10.0)
    assert f.waits(SEES, 200, 11.9)
    assert not f.waits(SEES, 200, 12.1)
    assert f.timeouts >= 1
    assert "slam" in f.hung
    assert not f.waits(SEES, 300, 12.2)
    f.answered("slam", 300)
    f.answered("refiner", 300)
    assert f.hung == ()
    assert f.waits(SEES, 400, 12.3)


def test_the_limit_begins_anew_with_each_wait() -> None:
    f = followers(Lives("camera", "slam"))
    f.answered("slam", 100)
    assert f.waits(("slam",), 200, 10.0)
    f.answered("slam", 200)
    assert f.waits(("slam",), 300, 13.0)


def test_bumping_into_the_ground_counts_as_a_touch() -> None:
    touches = Touches(0.25)
    touches.update(2.0)
    touches.update(2.0, bumped=True)
    touches.update(2.0, bumped=True)
    touches.update(2.0)
    assert touches.count == 1


CONFIG = SimulatorConfig(
    scene="single-01", reduced=True, px4=Px4Config(links=()), flight=FlightConfig(max_speed=20.0, limit_s=4.0)
)


class Bench:
    """The flying simulator on the bus in memory, with stand-ins that answer at once."""

    def __init__(self, config: SimulatorConfig = CONFIG, tree: TreedockConfig | None = None) -> None:
        self.hub = Hub(tree or TreedockConfig())
        self.now_s = 0.0
        self.context = self.hub.context("simulator")
        self.others = self.hub.context("others")
        self.silent: set[str] = set()
        self.frames: list[RgbdFrame] = []
        self.clocks: list[SimClock] = []
        self.truths: list[SimTruth] = []
        self.others.on(SIM_RGBD, self._on_frame)
        self.others.on(SIM_CLOCK, self._on_clock)
        self.others.on(SIM_TRUTH, self.truths.append)
        self.flight = Flight(cast(Context, self.context), config, wall=lambda: self.now_s)

    def live(self, *names: str) -> None:
        self.hub.live.update(names)

    def _on_frame(self, frame: RgbdFrame) -> None:
        self.frames.append(frame)
        if "slam" not in self.silent:
            pose = {"stamp_ns": frame.stamp_ns, "seq": frame.seq, "map_id": "m", "status": "lost", "reset_counter": 0,
                    "graph_version": 0, "inliers": 0, "up_sigma_rad": 0.0, "processing_ms": 1.0}  # fmt: skip
            self.others.publish(SLAM_POSE, Pose.model_validate(dict.fromkeys(Pose.model_fields) | pose))
        if not self.silent & {"slam", "refiner"}:
            target = {"stamp_ns": frame.stamp_ns, "seq": frame.seq, "map_id": "m", "status": "none", "measured": False}
            nothing = {name: None for name in Target.model_fields if name not in {*target, "note"}}
            self.others.publish(TREES_TARGET, Target.model_validate(nothing | target))

    def _on_clock(self, clock: SimClock) -> None:
        self.clocks.append(clock)
        if "navigator" not in self.silent:
            self.others.publish(MISSION_GUIDANCE, Guidance(
                stamp_ns=clock.stamp_ns, seq=0, map_id="m", command="stop", magnitude=0.0, unit="", engage=False,
                land=False, mission_id=0, reset_counter=0, setpoint=None,
            ))  # fmt: skip
        if "autopilot" not in self.silent:
            self.others.publish(VEHICLE_STATE, VehicleState(
                stamp_ns=clock.stamp_ns, seq=0, connected=True, armed=False, mode="hold", landed="on_ground",
                quaternion_map_body=None, position_map_m=None, velocity_map_m_s=None, battery_share=None,
                vision_fused=False, operator_override=False, engaged_mission_id=0, link_age_s=0.0,
            ))  # fmt: skip

    def turns(self, wall_s: float, step_s: float = 0.002) -> None:
        for _ in range(round(wall_s / step_s)):
            self.now_s += step_s
            self.flight.turn()
            self.hub.run()

    @property
    def elapsed_s(self) -> float:
        return (self.flight.now_ns - self.frames[0].stamp_ns) * 1e-9 if self.frames else 0.0


@pytest.fixture
def bench() -> Bench:
    made = Bench()
    made.live("camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot")
    return made


def test_a_second_camera_looks_down_at_the_same_moment_and_is_waited_for() -> None:
    fusion = FusionConfig(enabled=True, second=SecondCameraConfig(enabled=True))
    config = CONFIG.model_copy(update={"sensor": SensorConfig(disparity_sigma_px=0.0, min_range_m=0.01)})
    made = Bench(config, TreedockConfig(fusion=fusion))
    made.live("camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot")
    second: list[RgbdFrame] = []
    made.others.on(SIM_SECOND, second.append)
    made.turns(1.0)
    assert [(f.stamp_ns, f.seq) for f in second] == [(f.stamp_ns, f.seq) for f in made.frames]
    depth = np.frombuffer(second[-1].depth, np.uint16).reshape(480, 640) / second[-1].intrinsics.depth_scale
    assert 0.02 < float(np.median(depth[200:280, 280:360])) < 0.12, (
        "it hangs 5 cm below a body that stands on 10 cm of legs"
    )
    made.live("second_camera", "second_slam")
    pose = {"map_id": "m", "status": "lost", "reset_counter": 0, "graph_version": 0, "inliers": 0, "up_sigma_rad": 0.0,
            "processing_ms": 1.0, "stamp_ns": second[-1].stamp_ns, "seq": 1}  # fmt: skip
    made.others.publish(SECOND_POSE, Pose.model_validate(dict.fromkeys(Pose.model_fields) | pose))
    made.turns(0.5)
    before = len(made.frames)
    made.turns(0.5)
    assert len(made.frames) <= before + 1, "its slam has not answered: time stands still"


def test_without_fusion_there_is_no_second_camera(bench: Bench) -> None:
    second: list[RgbdFrame] = []
    bench.others.on(SIM_SECOND, second.append)
    bench.turns(0.5)
    assert bench.frames
    assert not second


def test_time_begins_when_the_chain_lives_and_ends_at_the_limit(bench: Bench) -> None:
    bench.hub.live.discard("mapper")
    bench.turns(1.0)
    assert bench.frames == []
    bench.live("mapper")
    bench.turns(4.0)
    stamps = [frame.stamp_ns for frame in bench.frames]
    assert len(stamps) > 40
    gaps_s = {round((b - a) * 1e-9, 4) for a, b in itertools.pairwise(stamps)}
    assert gaps_s <= {0.06, 0.064, 0.068, 0.072}
    assert {t.stamp_ns for t in bench.truths} == set(stamps)
    times = [clock.stamp_ns for clock in bench.clocks]
    assert times == sorted(times)
    assert max(b - a for a, b in itertools.pairwise(times)) <= 12_000_000
    assert bench.clocks[-1].phase == "done"
    assert bench.truths[-1].touched == 0


@pytest.mark.parametrize("who", ["navigator", "autopilot"])
def test_time_is_never_far_ahead_of_those_who_steer_and_goes_on_without_the_dead(bench: Bench, who: str) -> None:
    bench.turns(0.5)
    bench.silent.add(who)
    at_ns = bench.flight.now_ns
    bench.turns(1.0)
    assert (bench.flight.now_ns - at_ns) * 1e-9 <= CONFIG.flight.lead_s + 0.013
    bench.hub.live.discard(who)
    at_ns = bench.flight.now_ns
    bench.turns(0.5)
    assert 0.4 < (bench.flight.now_ns - at_ns) * 1e-9 < 0.62, "real time while somebody is missing"


def test_the_next_frame_waits_for_slam_and_refiner(bench: Bench) -> None:
    bench.turns(0.5)
    bench.silent.add("refiner")
    bench.turns(0.3)
    sent, at_ns = len(bench.frames), bench.flight.now_ns
    bench.turns(1.0)
    assert len(bench.frames) == sent
    assert bench.flight.now_ns == at_ns
    bench.turns(2.0)  # the limit: it is hung
    assert len(bench.frames) > sent + 3
    bench.context.health.notes.clear()
    bench.flight._tell()
    assert "refiner did not answer" in bench.context.health.notes["lockstep"]
    bench.silent.clear()
    bench.turns(0.3)
    bench.flight._tell()
    assert "lockstep" not in bench.context.health.notes


def test_frames_are_lost_as_asked_and_the_same_each_time() -> None:
    lossy = CONFIG.model_copy(update={"flight": CONFIG.flight.model_copy(update={"drop_share": 0.3})})
    stamps = []
    for config in (CONFIG, lossy, lossy):
        made = Bench(config)
        made.live("camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot")
        made.turns(4.0)
        assert made.clocks[-1].phase == "done", "time goes on without them"
        stamps.append([frame.stamp_ns for frame in made.frames])
        gaps = [round((b - a) * 15e-9) for a, b in itertools.pairwise(stamps[-1])]
        assert set(gaps) == ({1} if config is CONFIG else set(gaps) & {1, 2, 3, 4, 5})
    assert 0.5 * len(stamps[0]) < len(stamps[1]) < 0.9 * len(stamps[0])
    assert stamps[1] == stamps[2]


def test_an_aircraft_that_is_armed_once_more_has_not_come_down(bench: Bench) -> None:
    flight, T = bench.flight, np.eye(4)
    T[:3, 3] = (0.0, 0.0, flight.stage.scene.ground.at(0.0, 0.0) + 2.0)
    flight.px4 = cast(SimulatedPx4, SimpleNamespace(on_ground=False, armed=True, mode=NavState.OFFBOARD))
    flight._feel(T)
    flight.px4 = cast(SimulatedPx4, SimpleNamespace(on_ground=True, armed=False, mode=NavState.LAND))
    T[2, 3] -= 1.9
    flight._feel(T)
    flight.px4 = cast(SimulatedPx4, SimpleNamespace(on_ground=True, armed=True, mode=NavState.OFFBOARD))
    flight._feel(T)
    assert flight.stage.touches.count == 0


def test_small_pictures_show_the_same_depth() -> None:
    scene = scene_by_name("single-01")
    exact = SensorConfig(disparity_sigma_px=0.0)
    full, small = (SimulatedCamera(World(scene), exact, small=small) for small in (False, True))
    T = level_camera([0.0, 0.0, 1.5 + scene.ground.at(0.0, 0.0)], scene.start_yaw_rad)
    here, there = full.look(T, 0).depth, small.look(T, 0).depth
    assert there.shape == (240, 320)
    assert small.intrinsics.width == 320
    both = (here[4::8, 4::8] > 0) & (there[2::4, 2::4] > 0)
    off = np.abs(here[4::8, 4::8].astype(float) - there[2::4, 2::4])[both]
    assert both.sum() > 500
    assert np.median(off) < 40.0
