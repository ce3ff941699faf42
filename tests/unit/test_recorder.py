"""Recordings: what goes in comes out, is listed and can be shown."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from mcap.reader import make_reader

from schemas.camera import RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, HEALTH, SLAM_POSE, TOPICS, TREES_LIST, VEHICLE_STATE, Topic
from services.camera.codecs import decode_depth_raw
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.sources import open_recording
from services.cli.app import invoke
from services.cli.replay import said
from services.common.errors import InputError
from services.common.stop import StopSignal
from services.recorder.config import RecorderConfig
from services.recorder.foxglove import Translator
from services.recorder.index import index
from services.recorder.mcap_file import McapFile
from services.recorder.reader import Recorded, messages
from services.recorder.replay import SENSORS, Played, Span, check, play_on
from services.recorder.service import recorded_topics
from tests.examples import submap, without_points
from tests.unit.recorder_files import MB, cut_at, example, frame, recorded


def test_what_is_recorded_follows_the_table() -> None:
    names = {topic.name for topic in recorded_topics(RecorderConfig())}
    expected = {t.name for t in TOPICS if t.recorded} - {"camera/rgbd", "cmd/*"}
    assert names == expected
    assert "camera/rgbd" in {t.name for t in recorded_topics(RecorderConfig(frames="raw"))}
    assert not any(t.name.startswith("camera") for t in recorded_topics(RecorderConfig(frames="off")))


def test_messages_come_out_as_they_went_in(tmp_path: Path) -> None:
    path = recorded(tmp_path)
    found = [entry for entry in messages(path) if isinstance(entry, Recorded)]
    poses = [e.message for e in found if e.topic is SLAM_POSE]
    assert poses == [example(Pose)] * 12
    frames: list[Any] = [e.message for e in found if e.topic is CAMERA_COMPRESSED]
    assert [bytes(f.to_bytes()) for f in frames] == [bytes(frame(n).to_bytes()) for n in range(12)]
    assert [e.stamp_ns for e in found if e.topic is CAMERA_COMPRESSED] == [frame(n).stamp_ns for n in range(12)]
    assert HEALTH.name in {t.name for t in recorded_topics(RecorderConfig())}


def test_process_and_run_read_the_frames_with_their_depth_untouched(tmp_path: Path) -> None:
    path = recorded(tmp_path)
    settings = CameraConfig(min_range_m=0.1, depth=DepthConfig(drop_mixed=False))
    frames = [f for f in open_recording(path, settings) if isinstance(f, RgbdFrame)]
    assert len(frames) == 12
    np.testing.assert_array_equal(decode_depth_raw(frames[3]), decode_depth_raw(frame(3)))


def test_foxglove_finds_its_schemas(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    with recorded(tmp_path).open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        shown = {
            c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values() if c.topic.startswith("/")
        }
        decoded = [data for _, channel, data in reader.iter_messages(topics=["/uav1/trees"]) if channel]
    assert shown == {
        "/uav1/image": "foxglove.CompressedImage", "/uav1/calibration": "foxglove.CameraCalibration",
        "/uav1/transform": "foxglove.FrameTransform", "/uav1/pose": "foxglove.PoseInFrame", "/uav1/trees": "foxglove.SceneUpdate",
    }  # fmt: skip
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    scene = SceneUpdate.FromString(decoded[0].data)
    trees = example(TREES_LIST.message).trees
    assert [entity.id for entity in scene.entities] == [f"tree-{tree.id}" for tree in trees]
    assert scene.entities[0].cylinders[0].size.x == pytest.approx(2 * trees[0].radius_m)


def test_foxglove_keeps_the_points_of_a_submap_that_the_graph_moved() -> None:
    translator, whole = Translator("uav1", 5.0), submap()
    ((name, first),) = translator.translate(whole)
    moved = without_points(whole, (1.0, 0.0, 0.0), later_s=6.0)
    ((_, second),) = translator.translate(moved)
    assert name == "/uav1/cloud"
    size = cast("Any", first).point_stride * len(whole.points_m)
    assert len(cast("Any", first).data) == len(cast("Any", second).data) == size
    assert cast("Any", first).data != cast("Any", second).data


def test_the_index_of_a_long_file_takes_little_memory_and_is_whole(tmp_path: Path) -> None:
    """What was seen in an hour's soak: 14 MB more, the library's own index of two chunks a second."""
    path, keys, chunks = tmp_path / "long.mcap", 25, 400
    with McapFile(path) as file:
        for number in range(chunks):
            for key in range(keys):
                file.add(f"key/{key}", "s", "e", bytes(100), number * 500_000_000 + key, number)
            file.flush(to_disk=False)
        kept_an_hour = 7200 / chunks * file.index_bytes
    assert kept_an_hour < 1.5 * MB
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == chunks
        starts = [index.message_start_time for index in summary.chunk_indexes]
        assert starts == [number * 500_000_000 for number in range(chunks)]
        assert all(len(index.message_index_offsets) == keys for index in summary.chunk_indexes)
        found = make_reader(stream).iter_messages(
            topics=["key/7"], starting_at=60_000_000_000, ending_before=61_000_000_000
        )
        assert [message.sequence for _, _, message in found] == [120, 121]


def test_recordings_are_listed_and_cut_ones_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(tmp_path)
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-50])
    runs = {run.path.name: run for run in index(tmp_path)}
    assert runs[path.name].count("camera/rgbd_compressed") == 12
    assert dict(runs[path.name].about)["uav"] == "uav1"
    assert not runs["cut.mcap"].whole
    assert invoke(["recordings", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "12 frames  " in out
    assert "12 versions of the trees" in out
    assert "cut short" in out
    assert invoke(["recordings", str(tmp_path), "--recover"]) == 0
    assert "cut short or" not in capsys.readouterr().out
    assert invoke(["recordings", str(tmp_path / "nowhere")]) == 2
    capsys.readouterr()
    assert invoke(["recordings", "--set", f"recorder.folder={tmp_path}"]) == 0
    assert "12 frames" in capsys.readouterr().out


def test_replay_refuses_what_it_cannot_play(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--to"):
        check(Span(5.0, 5.0))
    assert invoke(["replay", str(tmp_path / "none.mcap")]) == 2
    (tmp_path / "x.mcap").write_text("text")
    assert invoke(["replay", str(tmp_path / "x.mcap")]) == 2


def test_a_replay_from_beyond_the_end_is_refused_and_says_how_long_the_file_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recorded(tmp_path)
    assert invoke(["replay", str(path), "--from", "500"]) == 2
    assert f"--from 500 s: {path.name} is only 0.7 s long" in capsys.readouterr().err
    cut_at(path, 0.8)
    with pytest.raises(InputError, match=r"only 0\.\d s long"):
        played(path, Span(500.0))


def test_a_replay_of_nothing_says_how_long_the_recording_is(tmp_path: Path) -> None:
    path = recorded(tmp_path)
    short = Span(0.01, 0.02)
    assert said(path, short, played(path, short)) == (
        f"0 messages of {path.name} in 0.0 s; the recording is only 0.7 s long"
    )
    late = Span(0.7, 60.0)
    assert said(path, late, played(path, late)).endswith("; the recording is only 0.7 s long")
    last = Span(0.7)
    assert "long" not in said(path, last, played(path, last))


def test_on_an_encrypted_bus_a_replay_names_what_it_may_not_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The router drops it without a word, and the count said that all was sent."""
    path, sent = recorded(tmp_path), list[tuple[str, str | None]]()
    sessions: list[str] = []

    class Listener:
        uav = "uav1"

        def __init__(self, *_: object) -> None: ...

        def alive(self, _: str) -> bool:
            return False

        def publish(self, topic: Topic, _: object, leaf: str | None) -> None:
            sent.append((topic.name, leaf))

    def opened(_: object, service: str, *__: object, **___: object) -> contextlib.nullcontext[None]:
        sessions.append(service)
        return contextlib.nullcontext()

    monkeypatch.setattr("services.common.bus.Bus", Listener)
    monkeypatch.setattr("services.common.session.opened_node", opened)
    encrypted = ["--set", f"security.folder={tmp_path}", "--set", "router.protocol=tls"]
    assert invoke(["replay", str(path), "--everything", *encrypted, "--rate", "100"]) == 0
    assert sessions == ["camera"]
    assert {name for name, _ in sent} == {CAMERA_RGBD.name}
    words = capsys.readouterr().err
    assert "12 of slam/pose" in words
    assert "12 of vehicle/state: on an encrypted bus" in words
    sent.clear()
    assert invoke(["replay", str(path), "--everything", "--rate", "100"]) == 0
    assert {name for name, _ in sent} >= {CAMERA_RGBD.name, SLAM_POSE.name, VEHICLE_STATE.name}
    assert "left out" not in capsys.readouterr().err


def played(path: Path, span: Span) -> Played:
    bus: Any = SimpleNamespace(uav="uav1", alive=lambda _: False, publish=lambda *_: None)
    return play_on(bus, path, messages(path, SENSORS), span, StopSignal(), ())
