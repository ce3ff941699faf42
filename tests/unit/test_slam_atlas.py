"""The map's arrays: they grow under what is in them, and take memory only for what was written."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from services.slam import atlas as module
from services.slam.atlas import Atlas
from services.slam.features import Features

_FEATURES, _CELLS = 40, 6


def _features(number: int) -> Features:
    n = 20 + number % 20
    value, none = np.full(n, float(number)), np.zeros(n)
    return Features(
        np.full((n, 2), float(number)), np.full(n, number % 8, np.int32), value, np.full((n, 4), number, np.uint64),
        value + 1.0, none, np.zeros(n, np.bool_), value, np.full(_CELLS + 1, number, np.int32), np.arange(n, dtype=np.int32),
    )  # fmt: skip


def _filled(keyframes: int) -> Atlas:
    """Return a map of keyframes and of points, as many as each has features but one, that stand at its number."""
    atlas = Atlas(_FEATURES, _CELLS, 1.2, 8)
    first = atlas.reserve_points(1)
    atlas.points.n[first] = 1
    for number in range(keyframes):
        features = _features(number)
        own = atlas.reserve_points(len(features) - 1)
        atlas.points.n[own] = 1
        atlas.points.pos[own] = number
        k = atlas.add_keyframe(features, np.eye(3), np.full(3, float(number)), np.full(len(features), -1, np.int32))
        assert k == number
    return atlas


def _check(atlas: Atlas, keyframes: int) -> None:
    assert atlas.slots.tolist() == list(range(keyframes))
    for number in range(keyframes):
        features = atlas.features_of(number)
        assert len(features) == 20 + number % 20
        np.testing.assert_array_equal(features.uv, number)
        np.testing.assert_array_equal(features.desc, number)
        np.testing.assert_array_equal(atlas.keyframes.t[number], number)
    alive = np.flatnonzero(atlas.points.n)
    assert len(alive) == 1 + sum(19 + number % 20 for number in range(keyframes))
    np.testing.assert_array_equal(np.unique(atlas.points.pos[alive]), np.arange(keyframes))
    free = atlas.points.n == 0
    np.testing.assert_array_equal(atlas.points.parallax[free], -1.0)
    np.testing.assert_array_equal(atlas.keyframes.serial[atlas.keyframes.n == 0], -1)


def test_what_is_in_the_map_stays_as_it_grows() -> None:
    _check(_filled(300), 300)


def test_a_map_larger_than_its_room_moves_to_a_larger_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_POINTS", module._FIRST_POINTS)
    monkeypatch.setattr(module, "_KEYFRAMES", module._FIRST_KEYFRAMES)
    _check(_filled(300), 300)


def test_a_map_of_more_keyframes_than_points_can_name_is_refused() -> None:
    atlas = _filled(3)
    with pytest.raises(MemoryError, match="32768 keyframes"):
        atlas._grow_keyframes(40_000)
    _check(atlas, 3)


def test_growing_takes_no_copy_and_no_memory_for_what_was_not_written() -> None:
    atlas = Atlas(1000, _CELLS, 1.2, 8)
    before, before_mb = atlas.points, _held_mb()
    atlas.reserve_points(200_000)
    grown = atlas.points
    assert len(grown.n) > 200_000
    assert np.shares_memory(grown.frame, before.frame)
    room_mb = sum(array.nbytes for array in grown) / 1e6
    assert room_mb > 60.0
    assert _held_mb() - before_mb < 0.25 * room_mb


def _held_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
