"""The map on its way to the 3D view: thinned aboard, relayed by the station, never more than a page can hold."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

from schemas.envelope import DecodeError
from schemas.sketch import SubmapSketch
from schemas.topics import MAP_SKETCH, Reach
from services.mapper.dense_map import MapSubmap
from services.mapper.sketch import sketch_of
from services.security.access import rights_of
from services.security.identity import Identity
from services.station.cloud import CloudView

POINTS, REMOVED, MOVED = 0, 1, 2


def submap(number: int = 3, count: int = 9_000) -> MapSubmap:
    rng = np.random.default_rng(number)
    points = rng.uniform(-6.0, 6.0, (count, 3)).astype(np.float32)
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    return MapSubmap(number, 1, points, rng.integers(0, 255, (count, 3)).astype(np.uint8), T)


def told(frame: bytes) -> tuple[int, int, int, np.ndarray]:
    """Return number, kind, count and place of a page's frame."""
    at = 2 + frame[1]
    number, kind, count, *T = struct.unpack_from("<III12f", frame, at)
    assert len(frame) == at + 60 + 9 * count
    return number, kind, count, np.array(T).reshape(3, 4)


def test_a_sketch_holds_the_submaps_points_to_half_a_centimetre_and_passes_the_radio() -> None:
    whole = submap()
    sketch = SubmapSketch.from_bytes(sketch_of(whole, "m1", points=True).to_bytes())
    assert len(sketch.points_cm) == SubmapSketch.MAX_POINTS
    assert len(sketch.to_bytes()) <= MAP_SKETCH.max_bytes <= 60_000
    near = np.abs(sketch.points_cm[:50, None] * 0.01 - whole.points_m[None]).max(axis=2).argmin(axis=1)
    assert np.abs(sketch.points_cm[:50] * 0.01 - whole.points_m[near]).max() <= 0.00501
    assert (sketch.colour[:50] == whole.rgb[near]).all()


def test_every_first_part_of_a_sketch_is_an_even_sample() -> None:
    sketch = sketch_of(submap(), "m1", points=True)
    part = sketch.points_cm[:500] * 0.01
    assert np.abs(part.mean(axis=0)).max() < 0.5  # of a cube of 12 m about the origin
    assert part.std(axis=0) == pytest.approx([3.46] * 3, abs=0.35)


def test_a_broken_sketch_is_refused() -> None:
    good = sketch_of(submap(count=4), "m1", points=True)
    for bad in (
        replace(good, T_map_submap=np.diag([2.0, 1.0, 1.0, 1.0])), replace(good, stamp_ns=-1), replace(good, removed=True),
        replace(good, T_map_submap=np.full((4, 4), np.nan)), replace(good, map_id="m" * 201),
    ):  # fmt: skip
        with pytest.raises(DecodeError):
            SubmapSketch.from_bytes(bad.to_bytes())


def test_a_station_may_hear_the_sketch_and_not_the_whole_cloud() -> None:
    rights = rights_of(Identity.parse("station.alice"))
    assert MAP_SKETCH.reach is Reach.RADIO
    for keys in (rights.subscribe, rights.ask):
        assert any(key.endswith("/map/sketch") for key in keys)
        assert not any(key.endswith("/map/cloud") for key in keys)


def test_a_moved_submap_keeps_its_points_and_a_new_map_withdraws_the_old() -> None:
    view = CloudView("uav1")
    ((key, frame),) = view.take(sketch_of(submap(), "m1", points=True))
    assert told(frame)[:3] == (3, POINTS, 5_000)
    ((other, frame),) = view.take(sketch_of(submap(), "m1", points=False))
    number, kind, count, T = told(frame)
    assert (number, kind, count) == (3, MOVED, 0)
    assert T[:, 3] == pytest.approx([1.0, 2.0, 3.0])
    assert other != key, "a place that waits must not push the points out"
    assert view.take(sketch_of(submap(8), "m1", points=False)) == [], "a place without points says nothing"
    frames = [told(frame)[:2] for _, frame in view.take(sketch_of(submap(4), "m2", points=True))]
    assert frames == [(3, REMOVED), (4, POINTS)]
    assert [told(f)[:2] for _, f in view.take(sketch_of(submap(4), "m2", points=True, removed=True))] == [(4, REMOVED)]


def test_many_submaps_share_the_pages_room() -> None:
    view = CloudView("uav1", max_points=20_000)
    counts = [told(view.take(sketch_of(submap(n), "m1", points=True))[0][1])[2] for n in range(1, 41)]
    assert counts[:4] == [5_000] * 4
    assert counts[-1] == 500
