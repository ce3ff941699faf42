from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from schemas.camera import RgbdFrame
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SIM_RGBD
from services.camera import service
from services.camera.codecs import decode_depth_raw
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.sources import ConditionedSource
from services.camera.sources.base import Source
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.common.memory import Hub
from tests.camera_data import PERIOD_NS, depth_image, frame, write_tum

RANGE_ONLY = DepthConfig(drop_mixed=False, bilateral=False, fill_holes=False)
START_NS = 5_000_000_000


class Rig:
    """The camera service on a hub, and the frames it sent."""

    def __init__(self, config: CameraConfig, *, listened: bool = False) -> None:
        self.hub = Hub(TreedockConfig(camera=config), SimulatedClock(START_NS))
        self.frames: list[RgbdFrame] = []
        self.packed: list[RgbdFrame] = []
        ear = self.hub.context("ear")
        ear.on(CAMERA_RGBD, self.frames.append)
        if listened:
            ear.on(CAMERA_COMPRESSED, self.packed.append)
        self.context = self.hub.context("camera")
        service.build(cast("Context", self.context))

    @property
    def counters(self) -> dict[str, int]:
        return dict(self.context.health.counters)

    def simulate(self, image: RgbdFrame) -> None:
        self.hub.context("simulator").publish(SIM_RGBD, image)
        self.hub.run()


def tum(tmp_path: Path, **more: Any) -> CameraConfig:
    return CameraConfig(source=f"tum:{tmp_path}", **more)


def test_simulated_frames_are_passed_on_range_limited() -> None:
    rig = Rig(CameraConfig(min_range_m=1.0, max_range_m=5.0, depth=RANGE_ONLY))
    rig.simulate(frame(4))
    depth = depth_image(4)
    depth[(depth < 5000) | (depth > 25000)] = 0
    assert np.array_equal(decode_depth_raw(rig.frames[0]), depth)
    assert rig.frames[0].stamp_ns == frame(4).stamp_ns
    assert rig.packed == []


def test_a_bad_simulated_frame_is_dropped_counted_and_told_until_all_is_well() -> None:
    rig = Rig(CameraConfig())
    rig.simulate(dataclasses.replace(frame(1), depth=b"xx"))
    assert rig.frames == []
    assert rig.counters["dropped_bad_frame"] == 1
    assert "dropped" in rig.context.health.notes["frame"]
    for seq in range(30):
        rig.simulate(frame(seq, START_NS + seq * PERIOD_NS))
    assert rig.context.health.notes == {}
    assert rig.counters["frames"] == 30


def test_compressed_frames_are_sent_only_while_somebody_listens() -> None:
    rig = Rig(CameraConfig(min_range_m=0.0, max_range_m=13.0, depth=RANGE_ONLY), listened=True)
    rig.simulate(frame(2))
    (packed,) = rig.packed
    assert (packed.colour_encoding, packed.depth_encoding) == ("jpeg", "zstd")
    assert np.array_equal(decode_depth_raw(packed), depth_image(2))


def test_a_recording_is_replayed_at_its_pace_and_in_the_present(tmp_path: Path) -> None:
    write_tum(tmp_path / "s", 4)
    rig = Rig(tum(tmp_path / "s"))
    seen = []
    for step in range(60):
        rig.hub.advance_to(START_NS + step * 5_000_000)
        seen.append(len(rig.frames))
    arrivals = [seen.index(n) * 5_000_000 for n in (1, 2, 3, 4)]
    assert np.allclose(np.diff(arrivals), PERIOD_NS, atol=6_000_000)
    assert np.allclose(np.diff([f.stamp_ns for f in rig.frames]), PERIOD_NS)
    assert 0 <= rig.frames[0].stamp_ns - START_NS <= 10_000_000
    assert rig.counters["source_done"] == 1


@pytest.mark.parametrize(("rate", "expected"), [(1.0, 2), (2.0, 4)])
def test_the_rate_speeds_a_replay_up(tmp_path: Path, rate: float, expected: int) -> None:
    write_tum(tmp_path / "s", 8)
    rig = Rig(tum(tmp_path / "s", rate=rate))
    rig.hub.advance_to(START_NS + 120_000_000)
    assert len(rig.frames) == expected


def test_recorded_stamps_can_be_kept(tmp_path: Path) -> None:
    write_tum(tmp_path / "s", 2)
    rig = Rig(tum(tmp_path / "s", restamp=False))
    rig.hub.advance_to(START_NS + 200_000_000)
    assert [f.stamp_ns // 10**9 for f in rig.frames] == [1305031102, 1305031102]


def test_a_bad_recorded_frame_is_skipped_and_the_replay_goes_on(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 4)
    sorted((folder / "rgb").iterdir())[1].unlink()
    rig = Rig(tum(folder))
    rig.hub.advance_to(START_NS + 400_000_000)
    assert [f.seq for f in rig.frames] == [0, 2, 3]
    assert rig.counters["dropped_bad_frame"] == 1
    assert "no such file" in rig.context.health.notes["frame"]


@pytest.mark.parametrize("stray_at", [0, 3])
def test_a_stray_stamp_and_a_pause_leave_the_pace_as_it_is(stray_at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong stamp far ahead made the rest come all at once; a pause of an hour would be waited out."""
    good = [START_NS + k * PERIOD_NS for k in range(10)]
    good += [good[-1] + 3_600_000_000_000 + k * PERIOD_NS for k in range(10)]
    stamps = [*good[:stray_at], good[-1] + 10**15, *good[stray_at:]]

    class Stamped:
        name, paced, expected, remark = "stamped", True, None, ""

        def __iter__(self) -> Iterator[RgbdFrame]:
            return iter([frame(k, stamp_ns) for k, stamp_ns in enumerate(stamps)])

    config = CameraConfig(source="tum:made up", depth=RANGE_ONLY)
    monkeypatch.setattr(service, "open_source", lambda *_: ConditionedSource(cast("Source", Stamped()), config))
    rig = Rig(config)
    sent = []
    for k in range(1, 60):
        rig.hub.advance_to(START_NS + k * PERIOD_NS // 2)
        sent.append(len(rig.frames))
    assert rig.counters["dropped_bad_frame"] == 1
    assert sent[-1] == 20
    assert max(b - a for a, b in itertools.pairwise(sent)) <= 2


def test_a_source_that_cannot_be_opened_stops_the_service(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        Rig(tum(tmp_path / "none"))


def test_an_inverted_range_is_refused() -> None:
    with pytest.raises(ValueError, match="not below"):
        CameraConfig(min_range_m=3.0, max_range_m=2.0)
