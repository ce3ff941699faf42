"""Keeps a live map on disk, and takes it up again after the process was killed."""

from __future__ import annotations

import struct
import time
import zipfile
from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.common.errors import InputError
from services.common.state import boot_id
from services.slam.config import SlamConfig
from services.slam.features import Features, grid_of, grid_size
from services.slam.links import Keyframes, Points, describe, observe
from services.slam.slam import Slam
from services.slam.store import BEAT, KEYFRAME, TAKEN, Arrays, Header, Log, Store, StoredKeyframe, encode_keyframe

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

_WHOLE_NS = 5_000_000_000
"""The map as a whole is written so often while keyframes come, and at once when its frame has changed."""
_BEAT_NS = 5_000_000_000
_AGAIN, _AGAIN_NS = 3, 60_000_000_000
_VERSIONS_LOST = 1000
_KEYFRAMES_LOST = 100
_RESETS_LOST = 16
"""More graphs, keyframes and jumps than can have been told after the last that was written."""


def since_boot_ns() -> int:
    """Return the machine's time since boot, sleep included: unlike the wall clock it never steps."""
    return time.clock_gettime_ns(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def shape_of(intrinsics: Intrinsics, config: SlamConfig) -> str:
    """Return in one text what two maps must share to be one."""
    arrays = config.model_dump(include={"features", "levels", "scale", "baseline_m"})
    return f"{intrinsics.model_dump_json()} {arrays}"


class Keeper:
    """Writes what a Slam makes, on the thread that does its mapping. A disk that refuses ends it, and ``fault`` says so."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._slam: Slam | None = None
        self._whole_ns = 0
        self._beat_ns = 0
        self._era = -1
        self._made = 0
        self._written = 0
        self.fault = ""

    def begin(self, slam: Slam) -> None:
        """Keep a new map from its first keyframe on."""
        self._slam = slam
        try:
            self._store.begin(Header(slam.map_id, boot_id(), shape_of(slam.intrinsics, slam.config)))
        except InputError as error:
            self._fail(str(error))
            return
        slam.on_made, slam.on_settled = self.made, self.settled

    def resume(self, slam: Slam) -> None:
        """Go on with a map that was taken up again."""
        self._slam, self._era = slam, slam.era
        self._guarded(lambda: self._store.mark(TAKEN, since_boot_ns()))
        slam.on_made, slam.on_settled = self.made, self.settled

    def made(self, k: int) -> None:
        """Write a new keyframe."""
        slam = self._slam
        if slam is None or self.fault:
            return
        with slam.crew.step():
            stored = _stored(slam, k)
        self._guarded(lambda: self._store.append(KEYFRAME, encode_keyframe(stored)))
        self._made += 1

    def settled(self) -> None:
        """Write the whole map when it is time for it."""
        slam, now = self._slam, since_boot_ns()
        if slam is None or self.fault or (now - self._whole_ns < _WHOLE_NS and slam.era == self._era):
            return
        self._whole_ns, self._era = now, slam.era
        with slam.crew.step():
            arrays = whole_map(slam)
        self._guarded(lambda: self._store.write_map(arrays))
        alive = set(arrays["serial"].tolist())
        if self._store.full or self._made > 2 * len(alive) + 50:
            self._guarded(lambda: self._store.keep_only(alive))
            self._made = len(alive)
        if self._store.full:
            self._fail("the map on disk has reached its limit (slam.map_file_mb): later keyframes are not kept")

    def beat(self) -> None:
        """Say now and then that the map still lives."""
        slam, now = self._slam, since_boot_ns()
        if slam is None or self.fault or now - self._beat_ns < _BEAT_NS or not slam.crew.idle:
            return  # a busy crew writes keyframes
        self._beat_ns = now
        slam.crew.submit(lambda: self._guarded(lambda: self._store.mark(BEAT, now)))

    def let_go(self) -> None:
        """Keep this map no longer."""
        self._slam = None

    def end(self) -> None:
        """Throw the map away: slam was stopped, not killed."""
        self._slam = None
        self._store.end()

    def _guarded(self, write: Callable[[], None]) -> None:
        try:
            write()
        except (OSError, InputError) as error:
            self._fail(str(error))

    def _fail(self, why: str) -> None:
        self.fault = f"{why}; a restart would begin a new map"


def _stored(slam: Slam, k: int) -> StoredKeyframe:
    kf = slam.atlas.keyframes
    n = int(kf.n[k])
    columns: Arrays = {
        "uv": kf.uv[k, :n], "octave": kf.octave[k, :n], "angle": kf.angle[k, :n], "desc": kf.desc[k, :n],
        "depth": kf.depth[k, :n], "info": kf.info[k, :n], "far": kf.far[k, :n],
    }  # fmt: skip
    return StoredKeyframe(
        int(kf.serial[k]), slam.era, slam.graph_version, since_boot_ns(), kf.R[k].copy(), kf.t[k].copy(), columns
    )


def whole_map(slam: Slam) -> Arrays:
    """Return the map without its keyframes' features: what mapping has made of them."""
    points, kf, slots = slam.atlas.points, slam.atlas.keyframes, slam.atlas.slots
    ids = np.flatnonzero(points.n)
    frame, feature = observations(points, ids)
    return {
        "serial": kf.serial[slots], "R": kf.R[slots], "t": kf.t[slots],
        "pos": points.pos[ids], "born": points.born[ids], "found": points.found[ids], "visible": points.visible[ids],
        "n": points.n[ids], "frame": kf.serial[frame], "feature": feature,
        "numbers": np.array([slam.era, slam.graph_version, slam.reset_counter, since_boot_ns(),
                             slam.atlas.newest_serial]),
        "up_sigma_rad": np.array(slam.up_sigma_rad), "map_id": np.array(slam.map_id),
    }  # fmt: skip


def take_up(store: Store, slam: Slam, max_age_s: float) -> str:
    """Fill a fresh ``slam`` with the map on disk; return why not, or an empty text. ``slam.map_id`` is then the old one's.

    When the text is not empty ``slam`` may be half filled: to be thrown away.
    """
    try:
        log = store.read()
        return _unfit(log, slam, max_age_s) or _restore(log, _of_the_same_map(log, store.read_map()), slam)
    except (ValueError, LookupError, TypeError, struct.error, zipfile.BadZipFile) as error:
        return f"the map on disk cannot be read ({error})"


def _unfit(log: Log, slam: Slam, max_age_s: float) -> str:
    """Return why this map is not ours to take up, or an empty text."""
    now_ns = since_boot_ns()
    age_s = (now_ns - log.last_ns) * 1e-9
    if log.header is None or not log.keyframes:
        return "no map is kept"
    if log.header.boot != boot_id():
        return "the map on disk is from before the machine's last start"
    if not 0.0 <= age_s <= max_age_s:
        return f"the map on disk is {age_s:.0f} s old, more than {max_age_s:g} s (slam.map_max_age_s)"
    if log.header.camera != shape_of(slam.intrinsics, slam.config):
        return "the map on disk is another camera's"
    if sum(now_ns - taken_ns < _AGAIN_NS for taken_ns in log.taken_ns) >= _AGAIN:
        return f"the map on disk was taken up {_AGAIN} times within a minute: it may be what ends slam"
    return ""


def _of_the_same_map(log: Log, whole: Arrays) -> Arrays:
    """Return the whole map if it is the log's: one that was being written while another map was begun lies beside its log."""
    assert log.header is not None
    return whole if whole and str(whole["map_id"]) == log.header.map_id else {}


def _restore(log: Log, whole: Arrays, slam: Slam) -> str:
    """Put the map together; return why that failed, or an empty text."""
    keyframes = log.keyframes
    numbers = whole["numbers"] if whole else (max(k.era for k in keyframes), 0, 0, 0, -1)
    era, version, resets, _, newest = (int(x) for x in numbers)
    by_serial = {k.serial: k for k in keyframes}
    placed = _restore_whole(slam, whole, by_serial) if whole else 0
    later = [k for s, k in sorted(by_serial.items()) if s > newest and k.era == era]
    for keyframe in later:
        _insert(slam, keyframe)
    if placed + len(later) == 0:
        return "nothing sound is left of the map on disk"
    slam.atlas.next_serial(max(newest, *by_serial) + 1 + _KEYFRAMES_LOST)
    version = max(version, *(k.graph_version for k in keyframes))
    sigma = float(whole["up_sigma_rad"]) if whole else slam.up_sigma_rad
    assert log.header is not None
    slam.resume(log.header.map_id, version + _VERSIONS_LOST, (resets + _RESETS_LOST) % 256, sigma, era)
    return ""


def _restore_whole(slam: Slam, whole: Arrays, by_serial: dict[int, StoredKeyframe]) -> int:
    """Put the keyframes and points of a whole map into a fresh slam; return how many keyframes."""
    atlas = slam.atlas
    slot_of: dict[int, int] = {}
    for serial, R, t in zip(whole["serial"].tolist(), whole["R"], whole["t"], strict=True):
        if serial in by_serial:
            slot_of[serial] = _add(slam, by_serial[serial], R, t)
    lookup = np.full(int(whole["serial"].max()) + 1, -1, np.int32)
    lookup[list(slot_of)] = list(slot_of.values())
    ids = atlas.reserve_points(len(whole["n"]))
    points = atlas.points
    points.pos[ids], points.born[ids] = whole["pos"], whole["born"]
    points.found[ids], points.visible[ids] = whole["found"], whole["visible"]
    rejoin(points, atlas.keyframes, ids, whole["n"], lookup[whole["frame"]], whole["feature"], atlas.scales)
    return len(slot_of)


def _add(slam: Slam, stored: StoredKeyframe, R: F64, t: F64) -> int:
    """Add a keyframe that sees no points yet; return its slot."""
    slam.atlas.next_serial(stored.serial)
    features = _features(slam, stored.columns)
    k = slam.atlas.add_keyframe(features, R, t, np.full(len(features), -1, np.int32))
    slam.loops.places.add(stored.serial, features.desc)
    return k


def _insert(slam: Slam, stored: StoredKeyframe) -> None:
    """Add a keyframe younger than the whole map: it sees what its surroundings see, and makes points of the rest."""
    atlas = slam.atlas
    before = atlas.slots[-10:]
    k = _add(slam, stored, stored.R, stored.t)
    slam.mapping.join(k, before)


def _features(slam: Slam, columns: Arrays) -> Features:
    uv, depth = columns["uv"].astype(float), columns["depth"].astype(float)
    bf = slam.camera.array[4]
    disparity = np.where(depth > 0.0, bf / np.where(depth > 0.0, depth, 1.0), 0.0)
    start, items = grid_of(uv, *grid_size(slam.intrinsics))
    return Features(
        uv, columns["octave"].astype(np.int32), columns["angle"].astype(float), columns["desc"].copy(), depth,
        disparity, columns["far"].copy(), columns["info"].astype(float), start, items,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def observations(points: Points, ids: NDArray[np.int64]) -> tuple[I32, I32]:
    """Return keyframe slot and feature of all observations of points ``ids``, in one row."""
    total = 0
    for p in ids:
        total += points.n[p]
    frame, feature = np.empty(total, np.int32), np.empty(total, np.int32)
    at = 0
    for p in ids:
        for j in range(points.n[p]):
            frame[at], feature[at] = points.frame[p, j], points.feature[p, j]
            at += 1
    return frame, feature


@njit(cache=True, nogil=True)
def rejoin(points: Points, kf: Keyframes, ids: I32, n: I32, frame: I32, feature: I32, scales: F64) -> None:
    """Record the observations of restored points ``ids`` (n[i] each, in one row); those of missing keyframes are left out."""
    at = 0
    for i in range(len(ids)):
        for o in range(at, at + n[i]):
            if frame[o] >= 0 and feature[o] < kf.n[frame[o]]:
                observe(points, kf, ids[i], frame[o], feature[o])
        at += n[i]
        if points.n[ids[i]] > 0:
            describe(points, kf, ids[i], scales)
