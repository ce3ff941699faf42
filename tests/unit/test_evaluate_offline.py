from __future__ import annotations

from pathlib import Path

import pytest

from schemas.camera import RgbdFrame
from schemas.codec import encode
from schemas.slam import Keyframe
from schemas.topics import CAMERA_RGBD, SLAM_KEYFRAME
from services.camera.sources import BadFrame
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.evaluate.metrics import metrics, summary_ms
from services.evaluate.offline import run_offline
from services.evaluate.sequence import recorded_keyframes
from services.recorder.mcap_file import McapFile
from tests.camera_data import frame, stamp_ns
from tests.examples import all_messages
from tests.stub_chain import BUILDERS


def frames(count: int) -> list[RgbdFrame]:
    return [frame(i, stamp_ns(i)) for i in range(count)]


def test_every_frame_is_processed_in_lockstep() -> None:
    seen: list[int] = []
    result = run_offline(
        frames(6), TreedockConfig(), builders=BUILDERS, progress=lambda counts: seen.append(counts.tracked)
    )
    assert result.counts.frames == 6
    assert seen == [1, 2, 2, 3, 4, 5]
    assert [stamp for stamp, _ in result.online] == [stamp_ns(i) for i in (0, 1, 3, 4, 5)]
    assert len(result.stage_ms["slam.track"]) == 6
    values = metrics(result)
    assert (values["frames"], values["tracked_final"], values["trees"], values["cloud_points"]) == (6, 5, 0, 2)


def test_a_bad_frame_stops_the_run_unless_skipped() -> None:
    items: list[RgbdFrame | BadFrame] = [*frames(2), BadFrame(5, "x.png: truncated PNG"), frame(3, stamp_ns(3))]
    with pytest.raises(InputError, match=r"x\.png: truncated PNG"):
        run_offline(items, TreedockConfig(), builders=BUILDERS)
    result = run_offline(items, TreedockConfig(), builders=BUILDERS, skip_bad_frames=True)
    assert result.counts.frames == 3
    assert result.counts.skipped == ["x.png: truncated PNG"]


def test_stamps_that_do_not_rise_are_bad_frames() -> None:
    items = [frame(0, stamp_ns(0)), frame(1, stamp_ns(0))]
    with pytest.raises(InputError, match="does not rise"):
        run_offline(items, TreedockConfig(), builders=BUILDERS)


def test_a_source_without_a_usable_frame_is_refused() -> None:
    with pytest.raises(InputError, match=r"no usable frame among 1: a\.jpg"):
        run_offline([BadFrame(1, "a.jpg: empty")], TreedockConfig(), builders=BUILDERS, skip_bad_frames=True)
    with pytest.raises(InputError, match="no frames"):
        run_offline([], TreedockConfig(), builders=BUILDERS)


def test_the_keyframes_of_a_recorded_flight_are_read(tmp_path: Path) -> None:
    keyframe = next(m for m in all_messages().values() if isinstance(m, Keyframe))
    stamps = [stamp_ns(i) for i in (0, 3, 7)]
    with McapFile(tmp_path / "flight.mcap") as file:
        for stamp in stamps:
            data = encode(keyframe.model_copy(update={"stamp_ns": stamp}))
            file.add(SLAM_KEYFRAME.key("uav1"), Keyframe.schema_id(), Keyframe.encoding(), bytes(data), stamp)
    assert recorded_keyframes(tmp_path / "flight.mcap") == stamps
    assert recorded_keyframes(tmp_path) == [], "a folder has none"


def test_slam_is_told_of_a_flights_keyframes() -> None:
    told: list[tuple[int, ...]] = []

    class Told:
        keyframes_ns: tuple[int, ...] = ()
        slam = None

        def on_frame(self, _: RgbdFrame) -> None:
            told.append(self.keyframes_ns)

    def build(context: Context) -> Told:
        service = Told()
        context.on(CAMERA_RGBD, service.on_frame)
        return service

    run_offline(frames(2), TreedockConfig(), builders={"slam": build}, keyframes_ns=[stamp_ns(1)])
    assert told == [(stamp_ns(1),)] * 2


def test_durations_are_summed_up() -> None:
    assert summary_ms([]) == {"median": 0.0, "p99": 0.0, "max": 0.0, "count": 0}
    assert summary_ms([1.0, 2.0, 9.0])["median"] == 2.0
