"""Slow and full disks cost frames first, never wait, and are told."""

from __future__ import annotations

import random
import time
from pathlib import Path

from services.recorder.drain import Drain, Entry, Limits
from services.recorder.mcap_file import McapFile
from services.recorder.recover import is_whole, recover
from tests.unit.recorder_files import MB, entry, settled


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
