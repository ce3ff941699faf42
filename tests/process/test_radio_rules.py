"""What the router holds back where the radio lies, on a real router whose radio is the loopback."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
import zenoh

from schemas.topics import CAMERA_RGBD, PREVIEW_IMAGE, SLAM_KEYFRAME, SLAM_POSE
from services.common.session import free_port, opened, opened_client, router_config
from services.security.access import radio_rules

SECONDS = 3.0


@pytest.fixture
def endpoint() -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with opened(router_config(endpoint, radio_rules(("lo",)))):
        yield endpoint


def test_poses_are_thinned_and_what_is_too_big_stays_aboard(endpoint: str) -> None:
    heard: dict[str, list[int]] = {}

    def take(sample: zenoh.Sample) -> None:
        heard.setdefault(str(sample.key_expr), []).append(len(sample.payload))

    with (
        opened_client(endpoint, lambda: False, wait_s=5.0) as aircraft,
        opened_client(endpoint, lambda: False, wait_s=5.0) as ground,
    ):
        ground.declare_subscriber("treedock/**", take)
        time.sleep(0.5)
        end, sent = time.monotonic() + SECONDS, 0
        while time.monotonic() < end:
            aircraft.put(SLAM_POSE.key("uav1"), b"pose")
            sent += 1
            time.sleep(0.01)
        aircraft.put(PREVIEW_IMAGE.key("uav1"), bytes(PREVIEW_IMAGE.max_bytes + 1))
        for kept in (
            CAMERA_RGBD,
            SLAM_KEYFRAME,
        ):  # a tool's or recorder's certificate lets it listen from the ground, too
            aircraft.put(kept.key("uav1"), b"x")
        aircraft.put(PREVIEW_IMAGE.key("uav2"), bytes(PREVIEW_IMAGE.max_bytes))
        limit = time.monotonic() + 5.0
        while PREVIEW_IMAGE.key("uav2") not in heard and time.monotonic() < limit:
            time.sleep(0.05)
    assert CAMERA_RGBD.key("uav1") not in heard
    assert SLAM_KEYFRAME.key("uav1") not in heard
    poses = len(heard[SLAM_POSE.key("uav1")])
    assert sent > 3 * SLAM_POSE.radio_hz * SECONDS, "there was something to thin"
    assert 1 <= poses <= SLAM_POSE.radio_hz * SECONDS * 1.2 + 1
    assert heard[PREVIEW_IMAGE.key("uav2")] == [PREVIEW_IMAGE.max_bytes]
    assert PREVIEW_IMAGE.key("uav1") not in heard
