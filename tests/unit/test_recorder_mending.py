"""Recordings that were cut or damaged are mended, beside a recorder that records at once."""

from __future__ import annotations

import fcntl
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from mcap.reader import make_reader

from schemas.slam import Pose
from schemas.topics import SLAM_POSE
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.common.memory import Hub
from services.recorder.config import RecorderConfig
from services.recorder.index import index
from services.recorder.mcap_file import McapFile
from services.recorder.reader import Recorded, messages
from services.recorder.recover import is_whole, recover, recover_folder
from services.recorder.service import build
from tests.unit.recorder_files import cut_at, example, recorded


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


def test_of_two_menders_one_leaves_the_file_to_the_other(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    cut = recorded(tmp_path / "whole", frames=5).read_bytes()[:-100]
    path.write_bytes(cut)
    with path.open("rb") as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="mended by another process; nothing was done"):
            recover(path)
        assert recover_folder(tmp_path) == [], "nor is it looked at"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.mcap", "whole"]
    assert path.read_bytes() == cut
    assert recover(path).messages > 0


def test_a_mended_file_keeps_its_owner_and_its_rights(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(recorded(tmp_path / "whole", frames=5).read_bytes()[:-100])
    path.chmod(0o664)
    if os.geteuid() == 0:
        os.chown(path, 1234, 1235)
    before, mask = path.stat(), os.umask(0o077)
    try:
        recover(path)
    finally:
        os.umask(mask)
    after = path.stat()
    assert (after.st_mode, after.st_uid, after.st_gid) == (before.st_mode, before.st_uid, before.st_gid)


def test_one_file_that_cannot_be_read_does_not_keep_the_others_from_being_mended(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "a.mcap").mkdir()  # refuses to be opened, for root as well
    (tmp_path / "b.mcap").write_bytes(recorded(tmp_path / "whole", frames=5).read_bytes()[:-100])
    assert [done.path.name for done in recover_folder(tmp_path)] == ["b.mcap"]
    assert "a.mcap: cannot be looked at" in caplog.text


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

        with path.open("rb") as stream:
            last = max(int.from_bytes(message.data[:8], "big") for _, _, message in make_reader(stream).iter_messages())
        assert killed_ns - last < 1_000_000_000


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
