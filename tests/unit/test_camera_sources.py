from __future__ import annotations

import builtins
import dataclasses
import json
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.camera import RgbdFrame
from services.camera.codecs import decode_colour, decode_depth_raw
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.sources import BadFrame, open_recording, open_source
from services.camera.sources.associate import associate, unpaired
from services.camera.sources.mcap_file import FrameWriter, McapSource
from services.camera.sources.tum import TumSource
from services.common.errors import InputError
from tests.camera_data import CAMERA, colour_image, depth_image, frame, stamp_ns, write_tum

CONFIG = CameraConfig(min_range_m=0.3, max_range_m=7.0)
RANGE_ONLY = CONFIG.model_copy(update={"depth": DepthConfig(drop_mixed=False, bilateral=False, fill_holes=False)})


def frames_of(source: object) -> list[RgbdFrame]:
    items = list(source)  # type: ignore[call-overload]
    assert all(isinstance(item, RgbdFrame) for item in items), items
    return items


@pytest.mark.parametrize("associations", [True, False])
def test_a_tum_folder_gives_its_frames(tmp_path: Path, associations: bool) -> None:
    source = open_recording(write_tum(tmp_path / "s", 4, associations=associations), RANGE_ONLY)
    frames = frames_of(source)
    assert source.expected == 4
    assert [f.stamp_ns for f in frames] == [stamp_ns(i) for i in range(4)]
    assert [f.seq for f in frames] == [0, 1, 2, 3]
    assert frames[1].intrinsics.depth_scale == 5000.0
    wanted = depth_image(1)
    wanted[(wanted < 1500) | (wanted > 35000)] = 0
    assert np.array_equal(decode_depth_raw(frames[1]), wanted)
    assert np.abs(decode_colour(frames[1]).astype(int) - colour_image(1)).mean() < 6
    assert frames[1].accel_camera is None
    assert [f.depth_after_ns for f in frames] == [7_000_000] * 4


def test_the_accelerometer_is_turned_into_the_camera_frame(tmp_path: Path) -> None:
    frames = frames_of(TumSource(write_tum(tmp_path / "s", 3, accelerometer=True), CONFIG))
    for each in frames:
        assert each.accel_camera == pytest.approx((-0.1, -9.8, -0.5), abs=1e-9)


def test_accelerometer_mean_is_of_this_frames_interval(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 2)
    lines = [f"{(stamp_ns(1) - 10_000_000 * k) / 1e9:.6f} {k} 0 0\n" for k in range(6)]
    late = f"{stamp_ns(1) / 1e9 + 0.01:.6f} 1000 0 0\n"
    (folder / "accelerometer.txt").write_text("".join(lines) + late)
    frames = frames_of(TumSource(folder, CONFIG))
    assert frames[0].accel_camera is None
    assert frames[1].accel_camera == pytest.approx((-2.5, 0.0, 0.0))


def test_a_dead_accelerometer_tells_nothing(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 2, accelerometer=True)
    path = folder / "accelerometer.txt"
    path.write_text("".join(f"{line.split()[0]} 0 0 0\n" for line in path.read_text().splitlines()))
    assert [item.accel_camera for item in TumSource(folder, CONFIG) if isinstance(item, RgbdFrame)] == [None, None]


def test_groundtruth_is_never_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_tum(tmp_path / "s", 3)
    (folder / "groundtruth.txt").write_text("nonsense\n")
    opened: list[str] = []
    for module, name in ((builtins, "open"), (os, "open"), (__import__("io"), "open")):
        original: Callable[..., Any] = getattr(module, name)

        def spy(path: object, *args: object, _original: Callable[..., Any] = original, **kw: object) -> Any:
            opened.append(str(path))
            return _original(path, *args, **kw)

        monkeypatch.setattr(module, name, spy)
    frames_of(TumSource(folder, CONFIG))
    assert any(path.endswith("camera.json") for path in opened)
    assert not any("groundtruth.txt" in path for path in opened)


STAMPS = st.lists(st.integers(0, 10**9), max_size=30)


@given(colour=STAMPS, depth=STAMPS, within=st.integers(1, 10**8))
def test_association_uses_each_once_and_keeps_the_limit(colour: list[int], depth: list[int], within: int) -> None:
    a, b = np.array(colour, dtype=np.int64), np.array(depth, dtype=np.int64)
    pairs = associate(a, b, within)
    assert len({i for i, _ in pairs}) == len(pairs) == len({k for _, k in pairs})
    assert all(abs(int(a[i]) - int(b[k])) <= within for i, k in pairs)
    free_a, free_b = set(range(len(a))) - {i for i, _ in pairs}, set(range(len(b))) - {k for _, k in pairs}
    assert all(abs(int(a[i]) - int(b[k])) > within for i in free_a for k in free_b)
    assert [int(a[i]) for i, _ in pairs] == sorted(int(a[i]) for i, _ in pairs)


def test_association_prefers_the_nearest() -> None:
    assert associate(np.array([100, 110]), np.array([109, 130]), 20) == [(1, 0)]
    assert associate(np.array([100, 110]), np.array([99, 112, 300]), 20) == [(0, 0), (1, 1)]


@pytest.mark.parametrize(("shift_ms", "told"), [(0, False), (100, True), (-100, True)])
def test_pairs_of_two_moments_are_told(tmp_path: Path, shift_ms: int, told: bool) -> None:
    folder = write_tum(tmp_path / "s", 6, associations=True)
    path = folder / "associations.txt"
    rows = [line.split() for line in path.read_text().splitlines()]
    path.write_text("".join(f"{a} {b} {float(c) + shift_ms / 1e3:.6f} {d}\n" for a, b, c, d in rows))
    source = open_recording(folder, CONFIG)
    assert len(list(source)) == 6
    assert ("6 of 6 frames pair colour with depth of another time" in source.total()) == told
    assert not told or f"{shift_ms + 7:+d} ms" in source.total()


def test_an_hour_of_shifted_or_equal_stamps_needs_little_memory() -> None:
    colour_ns = np.arange(100_000, dtype=np.int64) * 33_333_333
    tracemalloc.start()
    try:
        assert associate(colour_ns, colour_ns + 10_000_000, 5_000_000) == []
        assert "usually 10 ms away" in unpaired(colour_ns, colour_ns + 10_000_000, 5_000_000)
        equal = np.zeros(20_000, dtype=np.int64)
        assert len(associate(equal, equal, 5_000_000)) <= 16
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


def test_lists_whose_stamps_are_shifted_say_by_how_much(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 6)
    rows = [line.split() for line in (folder / "depth.txt").read_text().splitlines()[1:]]
    (folder / "depth.txt").write_text("".join(f"{float(a) + 0.1:.6f} {b}\n" for a, b in rows))
    with pytest.raises(
        InputError, match=r"within 20 ms; the nearest is usually \d+ ms away: are the stamps .* shifted"
    ):
        open_recording(folder, CONFIG)


def test_a_camera_file_can_be_named(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 1)
    (folder / "camera.json").unlink()
    other = tmp_path / "other.json"
    other.write_text(json.dumps({**CAMERA, "fx": 77.0}))
    config = CONFIG.model_copy(update={"camera_file": str(other)})
    assert frames_of(TumSource(folder, config))[0].intrinsics.fx == 77.0


def test_bad_images_come_as_bad_frames_with_their_file(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 4)
    colour, depth = sorted((folder / "rgb").iterdir()), sorted((folder / "depth").iterdir())
    colour[0].unlink()
    colour[1].write_bytes(colour[1].read_bytes()[:-40])
    depth[2].write_bytes(depth[2].read_bytes()[:-40])
    items = list(TumSource(folder, CONFIG))
    assert [isinstance(item, BadFrame) for item in items] == [True, True, True, False]
    reasons = [item.reason for item in items if isinstance(item, BadFrame)]
    for path, word, reason in zip(
        (colour[0], colour[1], depth[2]), ("no such file", "truncated", "truncated"), reasons, strict=True
    ):
        assert str(path) in reason
        assert word in reason
        assert "\n" not in reason


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"fx": None}, "fx"), ({"fx": -1.0}, "fx"), ({"fx": "wide"}, "fx"), ({"fy": 0}, "fy"), ({"cx": float("nan")}, "cx"),
        ({"cx": 900.0}, "cx"), ({"cy": -3.0}, "cy"), ({"width": 0}, "width"), ({"width": 48.5}, "width"), ({"height": "32"}, "height"),
        ({"depth_scale": 0}, "depth_scale"), ({"depth_scale": float("inf")}, "depth_scale"), ({"k1": "x"}, "k1"), ({"k9": 1.0}, "k9: unknown name"),
        ({"depth_scale": 0.001}, "depth_scale: .*units per metre"), ({"depth_scale": 1e300}, "depth_scale"), ({"fx": 1e300}, "fx"),
        ({"fy": 1.5}, "fy: 1.5 px is no focal length"), ({"fx": 9e4}, "fx: .* is no focal length"), ({"k1": 1e200}, "k1"),
    ],
)  # fmt: skip
def test_each_field_of_camera_json_is_checked(tmp_path: Path, change: dict[str, Any], fault: str) -> None:
    folder = write_tum(tmp_path / "s", 1)
    (folder / "camera.json").write_text(json.dumps({**CAMERA, **change}))
    with pytest.raises(InputError, match=rf"camera\.json: {fault}"):
        TumSource(folder, CONFIG)


@pytest.mark.parametrize("field", sorted(CAMERA))
def test_each_missing_field_of_camera_json_is_named(tmp_path: Path, field: str) -> None:
    folder = write_tum(tmp_path / "s", 1)
    (folder / "camera.json").write_text(json.dumps({key: value for key, value in CAMERA.items() if key != field}))
    with pytest.raises(InputError, match=rf"camera\.json: {field} missing"):
        TumSource(folder, CONFIG)


@pytest.mark.parametrize("content", ["", "{", "[1, 2]", "null", "\x00\xff", '{"width": 48,}'])
def test_camera_json_that_is_no_object_is_refused(tmp_path: Path, content: str) -> None:
    folder = write_tum(tmp_path / "s", 1)
    (folder / "camera.json").write_text(content)
    with pytest.raises(InputError, match=r"camera\.json"):
        TumSource(folder, CONFIG)


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("rgb.txt", "1.0\n", r"rgb\.txt:1: 1 fields"),
        ("rgb.txt", "abc rgb/x.jpg\n", r"rgb\.txt:1: the stamp 'abc'"),
        ("rgb.txt", "nan rgb/x.jpg\n", "the stamp 'nan'"),
        ("depth.txt", "-1.0 depth/x.png\n", "the stamp '-1.0'"),
        ("depth.txt", "# nothing\n", "no frames"),
        ("associations.txt", "1.0 rgb/x.jpg 1.0\n", r"associations\.txt:1: 3 fields"),
        ("associations.txt", "1.0 a 1.0 b\n1.0 a 1.0 b\n", "two frames with the stamp"),
        ("accelerometer.txt", "1.0 0 nan 0\n", r"accelerometer\.txt:1: 'nan'"),
        ("accelerometer.txt", "1.0 0 0\n", "3 fields"),
        ("accelerometer.txt", "1.0 0 1e308 0\n", r"accelerometer\.txt:1: .* is no acceleration"),
    ],
)
def test_broken_lists_are_refused_by_file_and_line(tmp_path: Path, name: str, content: str, fault: str) -> None:
    folder = write_tum(tmp_path / "s", 2)
    (folder / name).write_text(content)
    with pytest.raises(InputError, match=fault):
        TumSource(folder, CONFIG)


def test_a_name_that_no_file_can_have_is_a_bad_frame(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 1)
    (folder / "associations.txt").write_text("1.0 rgb/a\0b 1.0 depth/c\n")
    (item,) = TumSource(folder, CONFIG)
    assert isinstance(item, BadFrame)
    assert r"a\x00b" in item.reason


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "s", 2)
    for name in ("camera.json", "rgb.txt"):
        (folder / name).write_bytes(b"\xef\xbb\xbf" + (folder / name).read_bytes())
    assert len(list(TumSource(folder, CONFIG))) == 2


def test_missing_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file or folder"):
        open_recording(tmp_path / "none", CONFIG)
    with pytest.raises(InputError, match=r"rgb\.txt: no such file; expected a TUM"):
        open_recording(tmp_path, CONFIG)


def write_mcap(path: Path, count: int = 5, **options: Any) -> Path:
    with FrameWriter(path, **options) as writer:
        for index in range(count):
            writer.add(frame(index, stamp_ns(index)))
    return path


def test_an_mcap_file_gives_back_its_frames(tmp_path: Path) -> None:
    source = open_recording(write_mcap(tmp_path / "a.mcap"), RANGE_ONLY)
    frames = frames_of(source)
    assert source.expected == 5
    assert [f.stamp_ns for f in frames] == [stamp_ns(i) for i in range(5)]
    wanted = depth_image(2)
    wanted[(wanted < 1500) | (wanted > 35000)] = 0
    assert np.array_equal(decode_depth_raw(frames[2]), wanted)
    assert frames[2].colour_encoding == "bgr8"


def test_a_recording_carries_its_own_intrinsics(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", 1)
    with pytest.raises(InputError, match="carries its own intrinsics"):
        McapSource(path, CONFIG.model_copy(update={"camera_file": "other.json"}))


def test_a_recorded_dead_accelerometer_tells_nothing(tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "a.mcap") as writer:
        for force in ((0.0, 0.0, 0.0), (0.0, -9.8, 0.0)):
            writer.add(dataclasses.replace(frame(), accel_camera=force))
    items = list(McapSource(tmp_path / "a.mcap", CONFIG))
    assert [item.accel_camera for item in items if isinstance(item, RgbdFrame)] == [None, (0.0, -9.8, 0.0)]


def test_a_recording_keeps_the_depths_own_stamp(tmp_path: Path) -> None:
    with FrameWriter(tmp_path / "a.mcap") as writer:
        writer.add(dataclasses.replace(frame(), depth_after_ns=-19_500_000))
    items = frames_of(open_recording(tmp_path / "a.mcap", CONFIG))
    assert [item.depth_after_ns for item in items] == [-19_500_000]


def test_lossless_colour_is_a_setting(tmp_path: Path) -> None:
    source = McapSource(write_mcap(tmp_path / "a.mcap", colour="bgr8", depth="zstd"), CONFIG)
    assert np.array_equal(decode_colour(frames_of(source)[3]), colour_image(3))


def test_a_recording_cut_by_a_power_failure_gives_what_is_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "cut.mcap"
    with FrameWriter(path, colour="bgr8", depth="z16") as writer:
        for index in range(3000):
            noisy = frame(index, stamp_ns(index))
            writer.add(RgbdFrame(**{**noisy.__dict__, "colour": rng.bytes(48 * 32 * 3)}))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.7 * len(whole))])
    items = list(McapSource(path, CONFIG))
    assert isinstance(items[-1], BadFrame)
    assert "cut" in items[-1].reason
    assert str(path) in items[-1].reason
    assert len(items) > 500
    assert all(isinstance(item, RgbdFrame) for item in items[:-1])


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    foreign = tmp_path / "x.mcap"
    foreign.write_bytes(b"not mcap at all, not at all")
    with pytest.raises(InputError, match=r"x\.mcap: no usable recording"):
        open_recording(foreign, CONFIG)
    foreign.write_bytes(b"")
    with pytest.raises(InputError, match=r"x\.mcap: no usable recording"):
        open_recording(foreign, CONFIG)
    with pytest.raises(InputError, match=r"no treedock\.rgbd frames"):
        open_recording(write_mcap(tmp_path / "empty.mcap", 0), CONFIG)


def test_a_damaged_chunk_ends_the_recording_with_a_word(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 255
    path.write_bytes(bytes(data))
    items = list(McapSource(path, CONFIG))
    assert isinstance(items[-1], BadFrame)
    assert "damaged" in items[-1].reason


def test_unknown_sources_and_a_missing_realsense_library_say_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyrealsense2", None)
    with pytest.raises(InputError, match="pip install pyrealsense2"):
        open_source("realsense", CONFIG)
    for spec in ("kinect", "tum:", "mcap", ""):
        with pytest.raises(InputError, match="expected sim, tum:DIR"):
            open_source(spec, CONFIG)
