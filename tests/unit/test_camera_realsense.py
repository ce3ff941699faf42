from __future__ import annotations

import json
import sys
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from schemas.camera import RgbdFrame
from services.camera.codecs import decode_depth_raw
from services.camera.config import CameraConfig, RealsenseConfig
from services.camera.service import CameraService, Replay
from services.camera.sources import BadFrame, ConditionedSource
from services.camera.sources.realsense import RealsenseSource
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.memory import Hub
from tests.fake_realsense import Camera, module


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> Camera:
    made = Camera()
    monkeypatch.setitem(sys.modules, "pyrealsense2", module(made))
    return made


def source(camera: Camera, **settings: object) -> RealsenseSource:
    config = CameraConfig(realsense=RealsenseConfig.model_validate(settings))
    return RealsenseSource(config, lambda: camera.now_ns, camera.sleep)


def test_frames_come_with_the_devices_stamps_and_intrinsics(camera: Camera) -> None:
    frames = list(islice(source(camera), 5))
    assert all(isinstance(frame, RgbdFrame) for frame in frames)
    good = [frame for frame in frames if isinstance(frame, RgbdFrame)]
    assert [frame.seq for frame in good] == [0, 1, 2, 3, 4]
    assert np.allclose(np.diff([frame.stamp_ns for frame in good]), 33_000_000, atol=1000)
    assert camera.now_ns - good[-1].stamp_ns == pytest.approx(20_000_000, abs=1000), "exposure, not arrival"
    assert good[0].intrinsics.fx == 610.0
    assert good[0].intrinsics.depth_scale == pytest.approx(1000.0)
    assert int(decode_depth_raw(good[2])[0, 0]) == 1503


def test_depth_of_another_moment_says_so(camera: Camera) -> None:
    camera.depth_late_ms = -6.0
    (frame,) = islice(source(camera), 1)
    assert isinstance(frame, RgbdFrame)
    assert frame.depth_after_ns == -6_000_000


def test_a_device_clock_that_is_not_ours_gives_the_arrival(camera: Camera) -> None:
    camera.domain, camera.depth_late_ms = "hardware_clock", 6.0
    (frame,) = islice(source(camera), 1)
    assert isinstance(frame, RgbdFrame)
    assert frame.stamp_ns == camera.now_ns
    assert frame.depth_after_ns == 0


def test_the_defaults_are_for_outdoors(camera: Camera) -> None:
    source(camera)
    assert camera.depth.set == {
        "visual_preset": 3.0, "emitter_enabled": 1.0, "laser_power": 360.0, "enable_auto_exposure": 1.0,
        "global_time_enabled": 1.0,
    }  # fmt: skip
    assert camera.colour.set == {"enable_auto_exposure": 1.0}
    assert ("depth", 640, 480, "z16", 30) in camera.streams


def test_each_setting_reaches_the_device(camera: Camera) -> None:
    source(
        camera, serial="123", rate_hz=15, preset="medium_density", projector=False, depth_exposure_us=8500.0,
        colour_exposure_us=20000.0, global_time=False,
    )  # fmt: skip
    assert camera.depth.set == {
        "visual_preset": 5.0, "emitter_enabled": 0.0, "enable_auto_exposure": 0.0, "exposure": 8500.0,
        "global_time_enabled": 0.0,
    }  # fmt: skip
    assert camera.colour.set == {"enable_auto_exposure": 0.0, "exposure": 10000.0}, "held within what the device takes"
    assert ("serial", "123") in camera.streams
    assert ("color", 640, 480, "bgr8", 15) in camera.streams
    camera.depth.set.clear()
    source(camera, preset="keep", laser_power_share=0.4)
    assert "visual_preset" not in camera.depth.set
    assert camera.depth.set["laser_power"] == 150.0, "40 % of 360, on the device's steps of 30"


def test_unplugged_and_plugged_in_again_it_goes_on(camera: Camera) -> None:
    items = iter(source(camera))
    assert isinstance(next(items), RgbdFrame)
    camera.plugged = False
    faults = [next(items) for _ in range(8)]
    assert all(isinstance(item, BadFrame) and "unplugged" in item.reason for item in faults)
    assert camera.slept_s > 0.5, "no busy loop while it is away"
    camera.plugged = True
    again = next(items)
    assert isinstance(again, RgbdFrame)
    assert again.seq == 1
    assert camera.starts == 2
    assert camera.depth.set["laser_power"] == 360.0


def test_another_camera_is_not_taken_for_the_one_that_went(camera: Camera) -> None:
    made = source(camera, serial="999")
    items = iter(made)
    next(items)
    camera.plugged = False
    next(items)
    camera.plugged = True  # the fake's serial number is 123
    item = next(items)
    assert isinstance(item, BadFrame)
    assert "unplugged" in item.reason


def test_a_hung_camera_is_started_again(camera: Camera) -> None:
    items = iter(source(camera))
    next(items)
    camera.hung = True
    reasons = []
    for item in islice(items, 30):
        if isinstance(item, RgbdFrame):
            break
        reasons.append(item.reason)
    assert "no frame within 200 ms" in reasons[0]
    assert "starting it again" in reasons[-1]
    assert 14 <= len(reasons) <= 18
    assert (camera.starts, camera.stops) == (2, 1)


def test_no_camera_and_a_file_of_another_size_are_told(camera: Camera, tmp_path: Path) -> None:
    camera.plugged = False
    with pytest.raises(InputError, match="No device connected; is a camera connected"):
        source(camera)
    file = tmp_path / "camera.json"
    body = {"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 320, "cy": 240, "k1": 0.1, "depth_scale": 1000}
    file.write_text(json.dumps({**body, "width": 1280}))
    camera.plugged = True
    with pytest.raises(InputError, match="1280x480, the camera sends 640x480"):
        RealsenseSource(CameraConfig(camera_file=str(file)))
    file.write_text(json.dumps({**body, "depth_scale": 5000}))
    made = RealsenseSource(CameraConfig(camera_file=str(file)))
    assert (made.intrinsics.fx, made.intrinsics.k1) == (600.0, 0.1)
    assert made.intrinsics.depth_scale == pytest.approx(1000.0), "the unit is the device's, whatever the file says"


def test_closing_the_source_stops_the_device(camera: Camera) -> None:
    items = iter(source(camera))
    next(items)
    items.close()  # type: ignore[attr-defined]
    assert camera.stops == 1


def live(camera: Camera) -> tuple[Hub, Replay, CameraService]:
    """Return a camera service on the fake device, both on one clock."""
    config = CameraConfig()
    hub = Hub(TreedockConfig(camera=config), SimulatedClock(camera.now_ns))
    service = CameraService(hub.context("camera"), config)
    made = ConditionedSource(RealsenseSource(config, lambda: camera.now_ns, camera.sleep), config)
    return hub, Replay(service, made, config), service


def test_a_stall_of_a_live_camera_is_counted_and_told_in_health(camera: Camera) -> None:
    hub, replay, service = live(camera)
    for _ in range(10):
        replay.tick()
        hub.clock.set_ns(camera.now_ns)
    camera.hung = True
    for _ in range(8):
        replay.tick()
        hub.clock.set_ns(camera.now_ns)
        replay.on_silence()
    health = service.context.health
    assert health.counters["stalls"] == 1
    assert "1 stalls, the longest 1." in health.notes["source"]
    assert health.counters["dropped_bad_frame"] == 8
    camera.hung = False
    for _ in range(40):
        replay.tick()
        hub.clock.set_ns(camera.now_ns)
        replay.on_silence()
    assert "source" not in health.notes
    assert health.counters["stalls"] == 1


def test_a_camera_that_repeats_one_picture_is_as_good_as_silent(camera: Camera) -> None:
    hub, replay, service = live(camera)
    for _ in range(10):
        replay.tick()
        hub.clock.set_ns(camera.now_ns)
    taken = camera.take

    def frozen(wait_ms: int) -> object:
        frames = taken(wait_ms)
        camera.frame = 10
        return frames

    camera.take = frozen  # type: ignore[method-assign]
    for _ in range(60):
        replay.tick()
        hub.clock.set_ns(camera.now_ns)
    health = service.context.health
    assert 10 + 30 <= health.counters["frames"] <= 10 + 33, "after a second of it nothing is sent on"
    assert health.counters["repeated_frames"] >= 58
    assert "one and the same picture" in health.notes["frame"]
