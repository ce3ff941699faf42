"""Recordings: what goes in comes out, cut files are mended, slow and full disks are told."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from mcap.reader import make_reader

from schemas.camera import Intrinsics, RgbdFrame
from schemas.slam import Pose
from schemas.topics import CAMERA_COMPRESSED, HEALTH, SLAM_POSE, TOPICS, TREES_LIST, VEHICLE_STATE
from services.camera.codecs import decode_depth_raw, encode_colour, encode_depth
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.sources import open_recording
from services.cli.app import invoke
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.common.memory import Hub
from services.recorder.config import RecorderConfig
from services.recorder.drain import Drain, Entry, Limits
from services.recorder.foxglove import Translator
from services.recorder.index import index
from services.recorder.mcap_file import McapFile
from services.recorder.reader import Recorded, messages
from services.recorder.recover import is_whole, recover, recover_folder
from services.recorder.replay import Span, check
from services.recorder.service import build, recorded_topics
from tests.examples import all_messages, submap, without_points

INTRINSICS = Intrinsics(width=64, height=48, fx=50.0, fy=50.0, cx=31.5, cy=23.5)
MB = 1_000_000


def frame(number: int) -> RgbdFrame:
    rng = np.random.default_rng(number)
    colour = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    depth = rng.integers(500, 5000, (48, 64)).astype(np.uint16)
    return RgbdFrame(
        stamp_ns=1_000_000_000 + number * 66_666_667, seq=number, intrinsics=INTRINSICS,
        colour=encode_colour(colour, "jpeg"), depth=encode_depth(depth, "zstd"), colour_encoding="jpeg", depth_encoding="zstd",
    )  # fmt: skip


def example(kind: type) -> Any:
    return next(e for e in all_messages().values() if type(e) is kind)


def recorded(folder: Path, frames: int = 12) -> Path:
    hub = Hub(TreedockConfig(recorder=RecorderConfig(folder=folder, reserve_mb=0)))
    service = build(cast("Context", hub.context("recorder")))
    other = hub.context("camera")
    for number in range(frames):
        hub.advance_to(frame(number).stamp_ns)
        other.publish(CAMERA_COMPRESSED, frame(number))
        for topic in (SLAM_POSE, TREES_LIST, VEHICLE_STATE):
            message = example(topic.message)
            other.publish(topic, message)
        hub.run()
    hub.stop()
    assert service.drain is not None
    assert service.drain.trouble == ""
    return next(folder.glob("*.mcap"))


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


def test_a_file_cut_anywhere_is_mended(tmp_path: Path) -> None:
    whole = recorded(tmp_path / "whole", frames=30).read_bytes()
    counts = []
    generator = random.Random(5)
    for number in range(60):
        path = tmp_path / f"cut-{number}.mcap"
        path.write_bytes(whole[: generator.randrange(0, len(whole))])
        assert not is_whole(path)
        done = recover(path)
        assert is_whole(path)
        counts.append((path.stat().st_size, done.messages))
        assert len([e for e in messages(path) if isinstance(e, Recorded)]) <= done.messages
    assert max(c for _, c in counts) > 0


def test_a_damaged_chunk_costs_itself_alone(tmp_path: Path) -> None:
    with McapFile(tmp_path / "a.mcap") as file:
        for number in range(10):
            file.add("treedock/v1/uav1/x", "s", "e", bytes([number]) * 400, number)
            file.flush()
    body = bytearray((tmp_path / "a.mcap").read_bytes())
    chunk = body.index(b"zstd", len(body) // 4)
    body[chunk + 14 : chunk + 18] = b"\xff\xff\xff\xff"
    cut = tmp_path / "b.mcap"
    cut.write_bytes(body[:-20])
    done = recover(cut)
    assert (done.messages, done.chunks_lost) == (9, 1)
    assert cut.with_name("b.mcap.cut").read_bytes() == bytes(body[:-20]), (
        "nothing is thrown away that was damaged inside"
    )


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"hello, this is text and no recording"])
def test_what_is_no_recording_is_refused_or_empty(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    if content.startswith(b"hello"):
        with pytest.raises(InputError, match="no MCAP file"):
            recover(path)
        assert path.read_bytes() == content
    else:
        assert recover(path).messages == 0


def test_a_file_being_written_is_left_alone(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "now.mcap")
    file.add("k", "s", "e", b"x", 1)
    file.flush()
    assert recover_folder(tmp_path) == []
    file.close()
    assert is_whole(tmp_path / "now.mcap")


WRITER = """
import sys, time
from pathlib import Path
from services.recorder.drain import Drain, Entry, Limits
from services.recorder.foxglove import Translator
from services.recorder.mcap_file import McapFile
drain = Drain(lambda: McapFile(Path(sys.argv[1])), Limits(0.1, 10**9, 10**8, 0), lambda: 10**12)
print("begun", flush=True)
for number in range(10**6):
    drain.put(Entry("treedock/v1/uav1/x", "s", "e", time.time_ns().to_bytes(8, "big") * 50, number, number, False))
    time.sleep(0.002)
"""


def test_a_killed_recorder_loses_at_most_a_second(tmp_path: Path) -> None:
    generator = random.Random(3)
    for number in range(4):
        path = tmp_path / f"{number}.mcap"
        process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(generator.uniform(0.3, 1.2))
        killed_ns = time.time_ns()
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()
        assert not is_whole(path)
        assert recover(path).messages > 0
        from mcap.reader import make_reader

        with path.open("rb") as stream:
            last = max(int.from_bytes(message.data[:8], "big") for _, _, message in make_reader(stream).iter_messages())
        assert killed_ns - last < 1_000_000_000


def cut_at(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])


def looked(service: Any, done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 240.0
    while not done() and time.monotonic() < deadline:
        service.tell()
        time.sleep(0.05)
    assert done()


def test_a_recorder_records_at_once_and_what_was_cut_is_mended_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was mended before READY: 15 s of processor for each gigabyte that a kill left cut."""

    def here(path: Path) -> None:
        pytest.fail(f"{path} is mended in the recorder's own process")

    monkeypatch.setattr("services.recorder.mender.recover", here)
    cut = recorded(tmp_path)
    cut_at(cut, 0.7)
    hub = Hub(TreedockConfig(recorder=RecorderConfig(folder=tmp_path, reserve_mb=0)))
    context = hub.context("recorder")
    service = build(cast("Context", context))
    hub.context("slam").publish(SLAM_POSE, example(Pose))
    hub.run()
    looked(service, lambda: context.health.counters["recordings_mended"] == 1)
    assert is_whole(cut)
    assert "recordings" not in context.health.notes
    hub.stop()
    assert len([run for run in index(tmp_path) if run.whole]) == 2


def test_without_room_a_cut_recording_is_left_and_that_is_told(tmp_path: Path) -> None:
    cut = recorded(tmp_path)
    cut_at(cut, 0.7)
    before = cut.read_bytes()
    hub = Hub(TreedockConfig(recorder=RecorderConfig(folder=tmp_path, reserve_mb=10**9)))
    context = hub.context("recorder")
    service = build(cast("Context", context))
    looked(service, lambda: "no room" in context.health.notes.get("recordings", ""))
    hub.stop()
    assert cut.read_bytes() == before


def entry(size: int, *, heavy: bool = False) -> Entry:
    return Entry("treedock/v1/uav1/x", "s", "e", bytes(size), 1, 0, heavy)


def settled(drain: Drain, name: str, value: int) -> None:
    deadline = time.monotonic() + 10.0
    while drain.counters[name] < value and time.monotonic() < deadline:
        time.sleep(0.02)
    assert drain.counters[name] >= value


def test_a_full_disk_stops_frames_first_then_all_and_recording_comes_back(tmp_path: Path) -> None:
    free, files = [200 * MB], iter(tmp_path / f"{n}.mcap" for n in range(10))
    drain = Drain(lambda: McapFile(next(files)), Limits(0.02, 10**9, 10**8, 100 * MB), lambda: free[0])
    drain.put(entry(10, heavy=True))
    settled(drain, "written", 1)
    free[0] = 50 * MB
    drain.put(entry(10, heavy=True))
    drain.put(entry(10))
    settled(drain, "written", 2)
    assert drain.counters["dropped_disk_full"] == 1
    assert "nearly full" in drain.trouble
    free[0] = 10 * MB
    drain.put(entry(10))
    settled(drain, "dropped_disk_full", 2)
    assert "nothing is recorded" in drain.trouble
    assert is_whole(tmp_path / "0.mcap"), "completed while there was room for its index"
    free[0] = 200 * MB
    drain.put(entry(10))
    settled(drain, "written", 3)
    drain.close()
    assert drain.trouble == ""
    assert is_whole(tmp_path / "1.mcap")


def test_a_slow_disk_costs_frames_first_and_never_waits(tmp_path: Path) -> None:
    slow = McapFile(tmp_path / "slow.mcap")
    whole_flush = slow.flush

    def flush(*, to_disk: bool = True) -> None:
        time.sleep(0.3)
        whole_flush(to_disk=to_disk)

    slow.flush = flush  # type: ignore[method-assign]
    drain = Drain(lambda: slow, Limits(0.01, 10**9, 1000, 0), lambda: 10**12)
    drain.put(entry(10))
    time.sleep(0.1)  # the thread is inside the slow flush now
    begun = time.monotonic()
    for _ in range(3):
        drain.put(entry(450, heavy=True))
    drain.put(entry(450))
    assert time.monotonic() - begun < 0.1
    assert drain.counters["dropped_slow_disk"] == 1, "the third frame"
    drain.close()
    assert drain.counters["written"] == 4


def test_a_disk_without_room_is_not_littered_with_empty_files(tmp_path: Path) -> None:
    """Without a reserve the disk's own refusal is the first word of it: 71 empty files in one mission were seen."""
    free, opened = [200 * MB], list[McapFile]()

    def opens() -> McapFile:
        opened.append(McapFile(tmp_path / f"{len(opened)}.mcap"))
        return opened[-1]

    drain = Drain(opens, Limits(0.01, 10**9, 10**8, 0), lambda: free[0])

    def refused(*, to_disk: bool = True) -> None:
        assert to_disk
        free[0] = 0
        raise OSError(28, "No space left on device")

    opened[0].flush = refused  # type: ignore[method-assign]
    drain.put(entry(10))
    settled(drain, "disk_errors", 1)
    for number in range(3):
        drain.put(entry(10))
        settled(drain, "dropped_disk_full", number + 1)
    assert len(opened) == 1
    assert "disk is full" in drain.trouble
    free[0] = 200 * MB
    drain.put(entry(10))
    settled(drain, "written", 2)
    drain.close()
    assert len(opened) == 2


def test_a_disk_error_costs_the_index_and_not_the_file(tmp_path: Path) -> None:
    first, second = McapFile(tmp_path / "1.mcap"), McapFile(tmp_path / "2.mcap")
    files = iter([first, second])
    drain = Drain(lambda: next(files), Limits(0.01, 10**9, 10**8, 0), lambda: 10**12)
    drain.put(entry(10))
    settled(drain, "written", 1)
    time.sleep(0.05)

    def broken(*, to_disk: bool = True) -> None:
        assert to_disk
        raise OSError(5, "Input/output error")

    first.flush = broken  # type: ignore[method-assign]
    drain.put(entry(10))
    settled(drain, "disk_errors", 1)
    drain.put(entry(10))
    settled(drain, "written", 3)
    drain.close()
    assert is_whole(tmp_path / "2.mcap")
    assert recover(tmp_path / "1.mcap").messages == 1


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


def test_files_are_changed_at_their_size(tmp_path: Path) -> None:
    names = (tmp_path / f"{n}.mcap" for n in range(10))
    drain = Drain(lambda: McapFile(next(names)), Limits(0.01, 2000, 10**8, 0), lambda: 10**12)
    for number in range(3):
        drain.put(Entry("k", "s", "e", random.Random(number).randbytes(3000), 1, 0, heavy=False))
        settled(drain, "written", number + 1)
        time.sleep(0.05)
    drain.close()
    assert len(list(tmp_path.glob("*.mcap"))) == 3
    assert all(is_whole(path) for path in tmp_path.glob("*.mcap"))


def test_recordings_are_listed_and_cut_ones_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(tmp_path)
    (tmp_path / "cut.mcap").write_bytes(path.read_bytes()[:-50])
    runs = {run.path.name: run for run in index(tmp_path)}
    assert runs[path.name].count("camera/rgbd_compressed") == 12
    assert dict(runs[path.name].about)["uav"] == "uav1"
    assert not runs["cut.mcap"].whole
    assert invoke(["recordings", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "12 frames" in out
    assert "cut short" in out
    assert invoke(["recordings", str(tmp_path), "--recover"]) == 0
    assert "cut short or" not in capsys.readouterr().out
    assert invoke(["recordings", str(tmp_path / "nowhere")]) == 2


def test_replay_refuses_what_it_cannot_play(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--to"):
        check(Span(5.0, 5.0))
    assert invoke(["replay", str(tmp_path / "none.mcap")]) == 2
    (tmp_path / "x.mcap").write_text("text")
    assert invoke(["replay", str(tmp_path / "x.mcap")]) == 2
