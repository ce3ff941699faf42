"""The map on disk: whatever byte it is cut or damaged at, it is read to the last sound record; a killed slam goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.common.context import HealthBook
from services.common.geometry import inverse
from services.slam import keeper as keeping
from services.slam.config import SlamConfig
from services.slam.keeper import Keeper, take_up
from services.slam.maps import LiveMaps
from services.slam.results import TrackResult
from services.slam.slam import Slam
from services.slam.store import (
    BEAT,
    HEADER,
    KEYFRAME,
    TAKEN,
    Arrays,
    Header,
    Store,
    StoredKeyframe,
    decode_keyframe,
    encode_keyframe,
    record,
    records,
)
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot

CONFIG = SlamConfig(features=300, disparity_sigma_px=0.15)
PERIOD_NS = 66_666_667
MOST = 50_000_000


def keyframe(serial: int, features: int = 5) -> StoredKeyframe:
    rng = np.random.default_rng(serial)
    n = features
    columns: Arrays = {
        "uv": rng.random((n, 2)).astype(np.float32), "octave": np.arange(n, dtype=np.uint8) % 8,
        "angle": rng.random(n).astype(np.float32), "desc": rng.integers(0, 2**63, (n, 4), dtype=np.uint64),
        "depth": rng.random(n).astype(np.float32), "info": rng.random(n).astype(np.float32), "far": rng.random(n) > 0.5,
    }  # fmt: skip
    return StoredKeyframe(serial, 2, 7 + serial, 10**9 * serial, np.eye(3), np.arange(3.0), columns)


def test_a_keyframe_comes_back_as_it_was() -> None:
    before = keyframe(3)
    after = decode_keyframe(encode_keyframe(before))
    assert (after.serial, after.era, after.graph_version, after.age_ns) == (3, 2, 10, 3 * 10**9)
    np.testing.assert_array_equal(after.t, before.t)
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.columns[name], column)


def test_nothing_waits_for_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Mapping would stand still, and tracking waits for it; a map is of use in the boot that made it only."""

    def forbidden(_: int) -> None:
        raise AssertionError("flushed to the disk")

    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(f"os.{name}", forbidden)
    store = Store(tmp_path, MOST)
    store.begin(Header("m", "boot", "camera"))
    for serial in range(3):
        store.append(KEYFRAME, encode_keyframe(keyframe(serial)))
    store.write_map({"numbers": np.arange(3)})
    store.keep_only({1, 2})
    assert [k.serial for k in store.read().keyframes] == [1, 2]
    assert store.read_map()["numbers"].tolist() == [0, 1, 2]


WHOLE = [
    record(HEADER, b'{"a": 1}'),
    *(record(KEYFRAME, encode_keyframe(keyframe(k))) for k in range(3)),
    record(BEAT, b"8" * 8),
]


def test_cut_at_any_byte_the_whole_records_before_are_read() -> None:
    data, ends = b"".join(WHOLE), np.cumsum([len(r) for r in WHOLE])
    for cut in range(len(data) + 1):
        assert len(list(records(data[:cut]))) == int((ends <= cut).sum())


@given(st.integers(0, sum(map(len, WHOLE)) - 1), st.binary(min_size=1, max_size=40))
@settings(max_examples=150, deadline=None)
def test_damage_costs_only_the_records_it_touches(at: int, junk: bytes) -> None:
    data, ends = b"".join(WHOLE), np.cumsum([len(r) for r in WHOLE])
    damaged = data[:at] + junk + data[at + len(junk) :]
    found = [body for _, body in records(damaged)]
    touched = {int(np.searchsorted(ends, byte, side="right")) for byte in range(at, min(at + len(junk), len(data)))}
    sound = [r for i, r in enumerate(WHOLE) if i not in touched]
    assert all(any(r.endswith(body) for body in found) for r in sound)
    assert all(any(r.endswith(body) for r in WHOLE) for body in found), "never a record that was not written"


def test_the_log_is_bounded_and_tidied(tmp_path: Path) -> None:
    store = Store(tmp_path, 3000)
    store.begin(Header("m", "b", "c"))
    for k in range(20):
        store.append(KEYFRAME, encode_keyframe(keyframe(k)))
    filled = store.full
    assert filled
    assert (tmp_path / "keyframes.log").stat().st_size <= 3000
    store.keep_only({2, 3})
    assert not store.full
    for k in range(3):
        store.mark(TAKEN, k)
    store.keep_only({2, 3})
    log = store.read()
    assert log.taken_ns == [0, 1, 2], "a map that ends slam again and again is to be noticed also with a full log"
    assert log.header == Header("m", "b", "c")
    assert [k.serial for k in log.keyframes] == [2, 3]


def test_a_damaged_whole_map_is_no_map(tmp_path: Path) -> None:
    store = Store(tmp_path, MOST)
    store.begin(Header("m", "b", "c"))
    store.write_map({"a": np.arange(4)})
    assert store.read_map()["a"].tolist() == [0, 1, 2, 3]
    data = bytearray((tmp_path / "map.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "map.npz").write_bytes(bytes(data))
    assert store.read_map() == {}
    assert store.damaged == [tmp_path / "map.npz"]


def kept_map(folder: Path, frames: int = 16) -> Slam:
    """Track a turn and keep its map, as a live slam does until it is killed; mapped at once, for the same result."""
    slam = Slam(INTRINSICS, CONFIG, map_id="map-old")
    keeper = Keeper(Store(folder, MOST))
    keeper.begin(slam)
    for k, T in enumerate(turn_on_the_spot(frames, 70.0)):
        slam.track(k * PERIOD_NS, *look(T))
    assert not keeper.fault
    return slam


def taken_up(folder: Path, max_age_s: float = 600.0) -> tuple[Slam, str]:
    slam = Slam(INTRINSICS, CONFIG)
    return slam, take_up(Store(folder, MOST), slam, max_age_s)


def test_a_killed_slam_goes_on_in_its_map_before_it_gives_a_pose(tmp_path: Path) -> None:
    old = kept_map(tmp_path)
    slam, why_not = taken_up(tmp_path)
    assert not why_not
    assert slam.map_id == "map-old"
    dark = slam.track(10**12, np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.float32))
    assert (dark.status, dark.T_map_camera, dark.graph) == ("relocalising", None, None)
    poses = turn_on_the_spot(16, 70.0)
    back = slam.track(10**12 + 1, *look(poses[9]))
    assert back.status == "tracking"
    assert back.graph is not None
    assert back.graph.reason == "restored"
    assert back.graph_version > old.graph_version
    assert back.reset_counter != old.reset_counter
    assert back.T_map_camera is not None
    true = dict(old.final_trajectory())[9 * PERIOD_NS]
    assert np.linalg.norm((inverse(true) @ back.T_map_camera)[:3, 3]) < 0.03
    after = [slam.track(10**12 + 2 + k, *look(T)) for k, T in enumerate(turn_on_the_spot(32, 140.0)[18:])]
    new = [n.keyframe_id for r in after for n in r.new_keyframes]
    assert new, "the turn goes on beyond the old map"
    assert min(new) > max(old.keyframe_poses()), "an old keyframe's number never names a new one"


def test_a_keyframe_that_was_told_but_not_written_lends_its_number_to_no_other(tmp_path: Path) -> None:
    told = max(kept_map(tmp_path).keyframe_poses())
    (tmp_path / "map.npz").unlink()
    log = tmp_path / "keyframes.log"
    kept = [record(kind, body) for kind, body in records(log.read_bytes())]
    log.write_bytes(b"".join(kept[:-1]))  # killed between the message and the disk
    slam, _ = taken_up(tmp_path)
    turn = [slam.track(10**12 + k, *look(T)) for k, T in enumerate(turn_on_the_spot(32, 140.0))]
    assert min(n.keyframe_id for r in turn for n in r.new_keyframes) > told, "the mapper has that one's points"


def test_without_the_whole_map_the_keyframes_alone_do(tmp_path: Path) -> None:
    kept_map(tmp_path)
    (tmp_path / "map.npz").unlink()
    slam, why_not = taken_up(tmp_path)
    assert not why_not
    assert slam.track(10**12, *look(turn_on_the_spot(16, 70.0)[2])).status == "tracking"


@pytest.mark.parametrize("share", [0.2, 0.5, 0.83, 0.999])
def test_a_log_torn_by_the_kill_still_serves(tmp_path: Path, share: float) -> None:
    kept_map(tmp_path)
    log = tmp_path / "keyframes.log"
    data = log.read_bytes()
    log.write_bytes(data[: int(share * len(data))])
    slam, why_not = taken_up(tmp_path)
    assert not why_not
    assert slam.track(10**12, *look(turn_on_the_spot(16, 70.0)[0])).status == "tracking"


def test_an_old_map_another_boots_or_another_cameras_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept_map(tmp_path)
    now_ns = keeping.since_boot_ns()
    monkeypatch.setattr(keeping, "since_boot_ns", lambda: now_ns + 601 * 10**9)
    assert "601 s old" in taken_up(tmp_path)[1]
    monkeypatch.setattr(keeping, "since_boot_ns", lambda: now_ns)
    other = Slam(INTRINSICS.model_copy(update={"fx": 300.0}), CONFIG)
    assert "another camera" in take_up(Store(tmp_path, MOST), other, 600.0)
    monkeypatch.setattr(keeping, "boot_id", lambda: "tomorrow")
    assert "last start" in taken_up(tmp_path)[1]
    assert "no map" in taken_up(tmp_path / "empty")[1]


def test_a_map_that_ends_slam_again_and_again_is_left(tmp_path: Path) -> None:
    kept_map(tmp_path, 3)
    whys = []
    for _ in range(4):
        slam, why_not = taken_up(tmp_path)
        whys.append(why_not)
        if not why_not:
            Keeper(Store(tmp_path, MOST)).resume(slam)
    assert whys[:3] == [""] * 3
    assert "3 times" in whys[3]


def test_a_whole_map_beside_another_maps_log_is_left(tmp_path: Path) -> None:
    old = kept_map(tmp_path)
    store = Store(tmp_path, MOST)
    foreign = store.read_map() | {"map_id": np.array("map-before")}
    foreign["t"] = foreign["t"] + 70.0
    store.write_map(foreign)
    slam, why_not = taken_up(tmp_path)
    assert not why_not
    truth = old.keyframe_poses()
    for serial, T in slam.keyframe_poses().items():
        np.testing.assert_allclose(T[:3, 3], truth.get(serial, T)[:3, 3], atol=0.05)


def test_a_whole_map_of_another_version_is_refused_not_fatal(tmp_path: Path) -> None:
    kept_map(tmp_path, 3)
    Store(tmp_path, MOST).write_map({"numbers": np.arange(2)})
    assert "cannot be read" in taken_up(tmp_path)[1]


@pytest.mark.parametrize(
    ("file", "share", "taken", "word"),
    [
        ("keyframes.log", None, 0, "keyframes.log: is damaged; the map is left"),
        ("map.npz", None, 1, "map.npz: is damaged; the map is put together from its keyframes"),
        ("map.npz", 0.5, 1, "map.npz: is damaged; the map is put together from its keyframes"),
        ("keyframes.log", 0.9, 1, ""),
    ],
)
def test_damage_is_told_by_the_files_name(
    tmp_path: Path, file: str, share: float | None, taken: int, word: str
) -> None:
    """Noise in either file, or a cut; a log that was cut at its end is what any kill may leave."""
    kept_map(tmp_path)
    data = (tmp_path / file).read_bytes()
    noise = np.random.default_rng(1).bytes(len(data))
    (tmp_path / file).write_bytes(noise if share is None else data[: int(share * len(data))])
    health = HealthBook()
    maps = LiveMaps(CONFIG, tmp_path, health)
    slam = maps.begin(INTRINSICS, 10**12)
    assert health.counters["bad_map_files"] == int(bool(word))
    assert health.counters["maps_taken_up"] == taken
    assert word in health.notes["map"]
    views = [look(T) for T in turn_on_the_spot(16, 70.0)]
    for step in (0, 9, 11):  # seconds; it is told for ten, whatever is tracked meanwhile
        maps.after(slam, slam.track(10**12 + 10**9 * step, *views[0]))
        assert bool(health.notes.get("map")) == (bool(word) and step < 10)
    maps.end()


def test_a_disk_that_refuses_is_told_and_slam_goes_on(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    health = HealthBook()
    maps = LiveMaps(CONFIG, tmp_path / "file" / "slam", health)
    slam = maps.begin(INTRINSICS, 1)
    result = slam.track(1, *look(turn_on_the_spot(1, 0.0)[0]))
    maps.after(slam, result)
    maps.end()
    assert result.status == "tracking"
    assert "new map" in health.notes["map on disk"]


def test_without_the_whole_map_the_last_eras_keyframes_are_its(tmp_path: Path) -> None:
    """Of before a turn or a loop none fits those after it; the map was put together from those before any alone."""
    kept_map(tmp_path)
    (tmp_path / "map.npz").unlink(missing_ok=True)
    store = Store(tmp_path, MOST)
    log = store.read()
    assert log.header is not None
    store.begin(log.header)
    for k in log.keyframes:
        store.append(KEYFRAME, encode_keyframe(replace(k, era=2 if k.serial >= 2 else 1)))
    slam, why_not = taken_up(tmp_path)
    assert not why_not
    assert slam.era == 2
    assert set(slam.keyframe_poses()) == {k.serial for k in log.keyframes if k.serial >= 2}


def lost_at(stamp_ns: int) -> TrackResult:
    return TrackResult(stamp_ns, "lost", None, None, None, None, [], None, 0, 1, 0, 0.1)


def test_a_pause_is_no_search() -> None:
    """A map is given up for 30 s without a place found, not for one frame before a pause of a minute and one after."""
    maps = LiveMaps(CONFIG, None, HealthBook())
    slam = maps.begin(INTRINSICS, 10**12)
    assert maps.after(slam, lost_at(10**12)) is slam
    assert maps.after(slam, lost_at(10**12 + 60 * 10**9)) is slam
    given_up = [maps.after(slam, lost_at(10**12 + 60 * 10**9 + k * 10**8)) is not slam for k in range(1, 291)]
    maps.end()
    assert given_up == [False] * 289 + [True]
