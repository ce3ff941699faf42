"""Real processes over a real router: what the bus promises."""

from __future__ import annotations

import signal
import time

import pytest
import zenoh

from schemas.camera import RgbdFrame
from schemas.simulation import SimClock
from schemas.slam import Keyframe, Pose
from schemas.topics import CAMERA_RGBD, SIM_CLOCK, SLAM_KEYFRAME, SLAM_POSE, TREES_LIST
from schemas.trees import TreeList
from services.common.bus import Bus
from services.common.config import TreedockConfig
from services.common.session import memory_settings, opened_node, shared_memory_note
from tests.process.conftest import HealthWatch, System, pump, stop_time_s, until
from tests.process.nodes import KEYFRAMES, tree_list


def test_whole_frames_pass_between_two_processes(routed: System) -> None:
    routed.start("camera")
    routed.start("slam")
    with routed.bus() as bus:
        health = HealthWatch(bus)
        assert until(lambda: health.counter("slam", "whole") >= 40, bus=bus), routed.said("slam")
        assert health.counter("slam", "wrong") == 0
        assert 10.0 < health.latest["slam"].rates_hz["camera/rgbd"] < 25.0


@pytest.mark.skipif(bool(shared_memory_note()), reason=shared_memory_note() or "shared memory is on")
def test_frames_come_through_shared_memory(routed: System) -> None:
    routed.start("camera")
    with routed.bus() as bus:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(1)
        subscriber = bus.session.declare_subscriber(CAMERA_RGBD.key("uav1"), ring)
        shared: list[bool] = []

        def look() -> bool:
            sample = subscriber.try_recv()
            if sample is not None:
                shared.append(sample.payload.as_shm() is not None)
            return len(shared) >= 10

        assert until(look)
        assert all(shared[2:])


@pytest.mark.parametrize("size", [150_000, 3_900_000, 9_000_000])
def test_what_does_not_fit_into_a_services_shared_memory_comes_all_the_same(routed: System, size: int) -> None:
    base = TreedockConfig()
    config = base.model_copy(update={"router": base.router.model_copy(update={"port": routed.port})})
    assert "transport/shared_memory/transport_optimization/pool_size" in memory_settings(config, "slam")
    got: list[bytes] = []
    with (
        opened_node(config, "mapper", lambda: False, 60.0) as to,
        opened_node(config, "slam", lambda: False, 60.0) as of,
    ):
        subscriber = to.declare_subscriber("test/large", lambda sample: got.append(bytes(sample.payload)))
        publisher = of.declare_publisher("test/large", congestion_control=zenoh.CongestionControl.BLOCK)
        assert until(lambda: bool(getattr(publisher.matching_status, "matching", publisher.matching_status)))
        sent = [bytes([number]) * size for number in range(3)]
        for payload in sent:
            publisher.put(payload)
        assert until(lambda: len(got) == len(sent))
        assert got == sent
        subscriber.undeclare()


def test_who_sends_raw_frames_keeps_room_for_them() -> None:
    size = "transport/shared_memory/transport_optimization/pool_size"
    config = TreedockConfig()
    assert all(size not in memory_settings(config, name) for name in ("camera", "second_camera", "simulator", None))
    assert all(size in memory_settings(config, name) for name in ("slam", "mapper", "detector", "refiner", "navigator"))


def test_a_late_joiner_gets_the_last_list_and_the_cached_keyframes(routed: System) -> None:
    routed.start("detector")
    with routed.bus() as early:
        assert until(lambda: early.live_services(0.2) == ["detector", "router"])
    lists: list[TreeList] = []
    keyframes: list[Keyframe] = []
    with routed.bus() as bus:
        bus.subscribe(TREES_LIST, lists.append)
        bus.subscribe(SLAM_KEYFRAME, keyframes.append)
        assert until(lambda: len(keyframes) >= KEYFRAMES and bool(lists), bus=bus)
        assert [k.keyframe_id for k in keyframes] == list(range(KEYFRAMES))
        assert lists == [tree_list(3)]


def test_a_subscriber_that_was_first_gets_everything_too(routed: System) -> None:
    keyframes: list[Keyframe] = []
    with routed.bus() as bus:
        bus.subscribe(SLAM_KEYFRAME, keyframes.append)
        routed.start("detector")
        assert until(lambda: len(keyframes) >= KEYFRAMES, bus=bus)
        assert [k.keyframe_id for k in keyframes] == list(range(KEYFRAMES))


def test_the_whole_state_is_answered(routed: System) -> None:
    routed.start("detector")
    with routed.bus() as bus:
        assert until(lambda: "detector" in bus.live_services(0.2))
        answers = bus.ask(TREES_LIST, None, TreeList, 2.0)
    assert sorted(answer.version for answer in answers) == [1, 2, 3]


def test_undecodable_samples_are_counted_and_never_fatal(routed: System) -> None:
    slam = routed.start("slam")
    with routed.bus() as bus:
        health = HealthWatch(bus)
        assert until(lambda: "slam" in bus.live_services(0.2))
        key, encoding = CAMERA_RGBD.key("uav1"), CAMERA_RGBD.encoding
        for payload, said in (
            (b"", encoding),
            (b"TDRF" + bytes(500), encoding),
            (b"x" * 4000, "text/plain"),
            (bytes(17 << 20), encoding),
        ):
            # on a busy machine 17 MB would else be dropped on the way
            bus.session.put(key, payload, encoding=said, congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(0.1)
        assert until(lambda: health.counter("slam", "decode_errors.camera/rgbd") == 4, bus=bus)
        assert slam.poll() is None
    said = routed.said("slam")
    assert "refused a sample on treedock/v1/uav1/camera/rgbd" in said
    assert "Traceback" not in said
    assert said.count("refused a sample") <= 2, "told once a second, not once a sample"


def test_data_that_a_handler_refuses_is_counted(routed: System) -> None:
    routed.start("refuser")
    with routed.bus() as bus:
        health = HealthWatch(bus)
        assert until(lambda: "refuser" in bus.live_services(0.2))
        pose = Pose(
            stamp_ns=1, seq=1, map_id="m", status="lost", T_map_camera=None, covariance=None, reset_counter=0,
            graph_version=0, keyframe_id=None, T_keyframe_camera=None, inliers=0, up_sigma_rad=0.1, processing_ms=1.0,
        )  # fmt: skip
        bus.publish(SLAM_POSE, pose)
        assert until(lambda: health.counter("refuser", "refused.slam/pose") == 1, bus=bus)


def test_sigterm_and_ctrl_c_end_a_service_within_a_second(routed: System) -> None:
    with routed.bus() as bus:
        for number in (signal.SIGTERM, signal.SIGINT):
            camera = routed.start("camera")
            assert until(lambda: "camera" in bus.live_services(0.2))
            assert stop_time_s(camera, number) < 1.0
            assert camera.returncode == 0
            assert until(lambda: "camera" not in bus.live_services(0.2))


def test_sigterm_ends_a_service_whose_handler_hangs(routed: System) -> None:
    hanger = routed.start("hanger")
    with routed.bus() as bus:
        assert until(lambda: "hanger" in bus.live_services(0.2))
    time.sleep(0.5)
    assert stop_time_s(hanger) < 2.0


def test_sigterm_ends_a_service_that_waits_for_its_router(system: System) -> None:
    camera = system.start("camera")
    assert until(lambda: system.log("camera").exists() and "waiting for a router" in system.said("camera")), "told"
    assert stop_time_s(camera) < 1.0
    assert camera.returncode == 0


def test_a_bug_ends_the_service_with_a_traceback_and_never_hangs(routed: System) -> None:
    crasher = routed.start("crasher")
    assert crasher.wait(timeout=8) == 1
    assert "RuntimeError: on purpose" in routed.said("crasher")
    assert "this is a bug" in routed.said("crasher")


def test_kill_drops_the_liveliness_token_at_once(routed: System) -> None:
    camera = routed.start("camera")
    with routed.bus() as bus:
        assert until(lambda: "camera" in bus.live_services(0.2))
        camera.kill()
        camera.wait()
        assert until(lambda: "camera" not in bus.live_services(0.2), timeout_s=1.0)


def test_services_come_back_after_the_router_was_restarted(routed: System) -> None:
    routed.start("camera")
    routed.start("slam")
    with routed.bus() as bus:
        health = HealthWatch(bus)
        assert until(lambda: health.counter("slam", "whole") >= 5, bus=bus)
        router = routed.processes[0]
        router.kill()
        router.wait()
        routed.start("router")
        before = health.counter("slam", "whole")
        health.latest.clear()
        assert until(lambda: health.counter("slam", "whole") > before + 10, bus=bus), routed.said("slam")
        assert until(lambda: bus.live_services(0.2) == ["camera", "router", "slam"])


def test_a_second_router_on_the_port_says_so(routed: System) -> None:
    second = routed.start("router")
    assert second.wait(timeout=8) != 0
    assert f"port {routed.port} on 127.0.0.1 is in use" in routed.said("router")


def test_a_slow_consumer_gets_the_newest_frame(routed: System) -> None:
    routed.start("camera")
    ages_s: list[float] = []
    with routed.bus() as bus:

        def note_age(got: RgbdFrame) -> None:
            ages_s.append(time.time() - got.stamp_ns * 1e-9)

        bus.subscribe(CAMERA_RGBD, note_age)
        assert until(lambda: bool(ages_s), bus=bus)
        ages_s.clear()
        for _ in range(4):
            time.sleep(0.5)
            pump(bus)
        assert 1 <= len(ages_s) <= 8, "between two looks all but the newest are dropped, of some forty"
        assert max(ages_s) < 1.0
        assert _dropped(bus) >= 5


def _dropped(bus: Bus) -> int:
    return bus.health.counters["dropped.camera/rgbd"]


def test_a_service_lives_by_the_simulators_time_but_tells_its_health_by_the_wall(routed: System) -> None:
    routed.start("ticker")
    with routed.bus() as bus:
        health = HealthWatch(bus)
        assert until(lambda: health.counter("ticker", "wall_ticks") >= 5, bus=bus)
        assert health.counter("ticker", "ticks") == 0, "time stands still"
        for tenth in range(1, 36):
            bus.publish(SIM_CLOCK, SimClock(stamp_ns=tenth * 100_000_000, seq=tenth, phase="running", frames=0))
            time.sleep(0.01)
        assert until(lambda: health.counter("ticker", "ticks") == 3, bus=bus), health.latest


def test_a_question_that_nobody_answers_in_time_is_told_in_plain_words(
    routed: System, caplog: pytest.LogCaptureFixture
) -> None:
    with routed.bus() as bus, routed.bus() as other, caplog.at_level("DEBUG"):
        queries: list[zenoh.Query] = []  # kept: nobody answers, and nobody says that he does not
        other.session.declare_queryable(TREES_LIST.key("uav1"), queries.append)
        assert until(lambda: bus.ask(TREES_LIST, None, TreeList, 0.2) == [] and bool(queries))
        told = [r for r in caplog.records if "trees/list" in r.getMessage()]
        assert (
            "trees/list was not answered within 0.2 s: who answers it is too busy, or the link is"
            in told[0].getMessage()
        )
        assert told[0].levelname == "WARNING"
        caplog.clear()
        bus.ask(TREES_LIST, None, TreeList, 0.2, quiet=True)
        assert not [r for r in caplog.records if r.levelname != "DEBUG"]
    assert "Timeout" not in caplog.text
