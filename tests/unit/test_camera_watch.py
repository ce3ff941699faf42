from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.camera.codecs import decode_depth_raw, encode_depth
from services.camera.config import CameraConfig
from services.camera.plausible import DepthScaleWatch
from services.camera.sources import open_recording
from services.camera.sources.mcap_file import FrameWriter
from services.camera.watch import StreamWatch, fingerprint
from services.cli.app import invoke
from services.evaluate import offline
from tests.camera_data import PERIOD_NS, frame, stamp_ns, write_tum
from tests.stub_chain import BUILDERS

MS = 1_000_000


def seen(stamps_ms: list[float]) -> StreamWatch:
    watch = StreamWatch()
    for number, stamp in enumerate(stamps_ms):
        watch.see(round(stamp * MS), number)
    return watch


def test_a_steady_stream_with_jitter_is_well() -> None:
    rng = np.random.default_rng(1)
    watch = seen(list(np.arange(200) * 66.7 + rng.uniform(-12, 12, 200)))
    assert watch.counts() == {"skipped_frames": 0, "repeated_frames": 0, "reordered_frames": 0, "stalls": 0}
    assert watch.note() == watch.total() == ""
    assert watch.period_s == pytest.approx(0.0667, abs=0.003)


def test_skipped_frames_are_counted_by_how_many_are_missing() -> None:
    stamps = [k * 33.3 for k in range(60) if k not in (20, 30, 31, 32)]
    watch = seen(stamps)
    assert watch.skipped == 4
    assert watch.total() == "4 frames missing beside 56 frames (about 30 Hz)"


def test_a_stall_is_one_stall_and_no_missing_frames() -> None:
    watch = seen([*(k * 33.3 for k in range(30)), *(4000 + k * 33.3 for k in range(5))])
    assert (watch.stalls, watch.skipped) == (1, 0)
    assert watch.longest_gap_s == pytest.approx(4.0 - 29 * 0.0333)
    assert "1 stalls, the longest 3.0 s" in watch.note()


def test_silence_is_told_while_it_lasts_and_counted_once() -> None:
    watch = seen([k * 33.3 for k in range(30)])
    assert not watch.silence(0.5)
    assert watch.silence(1.2)
    assert watch.silence(2.4)
    assert "the longest 2.4 s" in watch.note()
    watch.see(round((29 * 33.3 + 2500) * MS), 99)
    assert watch.stalls == 1
    assert not StreamWatch().silence(100.0), "a stream that never began does not stall"


def test_repeated_and_reordered_frames_are_counted() -> None:
    watch = seen([k * 33.3 for k in range(10)])
    watch.see(round(10 * 33.3 * MS), 9)
    watch.see(round(11 * 33.3 * MS), 9)
    assert (watch.repeated, watch.repeated_in_a_row) == (2, 2)
    watch.see(round(5 * 33.3 * MS), 50)
    assert (watch.reordered, watch.repeated_in_a_row) == (1, 0)
    watch.see(round(11 * 33.3 * MS), 51)
    assert watch.repeated == 3, "the stamp of a frame that came already"
    assert watch.skipped == 0


def test_the_note_goes_when_all_is_well_again() -> None:
    watch = seen([k * 33.3 for k in range(10)])
    watch.see(round(5 * 33.3 * MS), 50)
    assert watch.note()
    for k in range(10, 45):
        watch.see(round(k * 33.3 * MS), 100 + k)
    assert watch.note() == ""
    assert "1 out of order" in watch.total()


@given(stamps=st.lists(st.integers(0, 10**11), max_size=60), prints=st.lists(st.integers(0, 3), max_size=60))
def test_any_stream_is_counted_without_complaint(stamps: list[int], prints: list[int]) -> None:
    watch = StreamWatch()
    for stamp, print_ in zip(stamps, prints, strict=False):
        watch.see(stamp, print_)
    assert all(value >= 0 for value in watch.counts().values())
    assert "\n" not in watch.total()
    assert watch.repeated + watch.reordered <= watch.frames


def test_the_fingerprint_sees_images_and_not_stamps() -> None:
    one = frame(1)
    assert fingerprint(one) == fingerprint(dataclasses.replace(one, stamp_ns=5, seq=9))
    depth = decode_depth_raw(one).copy()
    depth[16, 3] += 1
    assert fingerprint(one) != fingerprint(dataclasses.replace(one, depth=encode_depth(depth, "z16")))
    assert fingerprint(one) != fingerprint(frame(2))


@pytest.mark.parametrize(
    ("scale", "told"), [(1000.0, False), (5000.0, False), (100.0, True), (1.0, True), (20_000.0, True)]
)
def test_a_depth_scale_that_cannot_be_right_is_told(scale: float, told: bool) -> None:
    rng = np.random.default_rng(2)
    watch = DepthScaleWatch()
    for _ in range(20):
        watch.see(rng.uniform(700, 5000, (480, 640)).astype(np.uint16), scale)
    assert bool(watch.note()) == told
    assert not told or f"is depth_scale {scale:g}" in watch.note()


def test_a_recording_mostly_out_of_range_is_told_at_the_end_and_not_in_flight() -> None:
    rng = np.random.default_rng(3)
    watch = DepthScaleWatch()
    for _ in range(20):
        watch.see(rng.uniform(3000, 12_000, (480, 640)).astype(np.uint16), 1000.0)
    assert watch.note() == ""
    assert "only 33% of the depth data lie within 0.5 to 6 m (median 7." in watch.total()


def test_process_tells_what_was_wrong_with_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(offline, "default_builders", lambda: BUILDERS)
    path = tmp_path / "a.mcap"
    with FrameWriter(path, colour="bgr8", depth="z16") as writer:
        for k in (0, 1, 2, 3, 4, 5, 6, 7, 10, 11, 9, 12, 13):
            writer.add(frame(12 if k == 13 else k, stamp_ns(k)))
    assert invoke(["process", str(path), "--out", str(tmp_path / "no")]) == 2
    assert "does not rise" in capsys.readouterr().err
    out = tmp_path / "out"
    assert invoke(["process", str(path), "--out", str(out), "--skip-bad-frames", "--json"]) == 0
    printed = capsys.readouterr()
    values = json.loads(printed.out)
    counters = values["counters"]
    assert counters["camera.skipped_frames"] == 2
    assert counters["camera.repeated_frames"] == 1
    assert counters["camera.reordered_frames"] == 1
    assert "2 frames missing, 1 repeated, 1 out of order" in printed.err
    assert values["source_note"].startswith("2 frames missing")
    assert values["ms"]["camera.range"]["count"] == 13


def test_a_wrong_depth_scale_is_told_by_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(offline, "default_builders", lambda: BUILDERS)
    folder = write_tum(tmp_path / "s", 20)
    camera = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps({**camera, "depth_scale": 50.0}))
    assert invoke(["process", str(folder), "--out", str(tmp_path / "out")]) == 0
    assert "is depth_scale 50 (units per metre) right?" in capsys.readouterr().err


def test_a_recordings_source_watches_by_its_own_stamps(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 12)
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join(lines[:8] + lines[9:]) + "\n")
    source = open_recording(folder, CameraConfig())
    assert len(list(source)) == 11
    assert source.watch.skipped == 1
    assert source.watch.period_s == pytest.approx(PERIOD_NS / 1e9)
