"""Stamps that jump: a wrong one is left out, a pause is gone on from, and neither is waited out."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.camera import RgbdFrame
from services.camera.sources.base import BadFrame
from services.camera.sources.strays import JUMP_NS, without_strays
from services.common.clock import SimulatedClock
from services.common.config import TreedockConfig
from services.common.memory import Hub
from tests.camera_data import frame

S = 10**9


def sorted_out(stamps_s: Iterable[float]) -> tuple[list[float], list[str]]:
    """Return the stamps of the good frames, in seconds, and the words on the bad ones."""
    items = list(without_strays(frame(k, round(t * S)) for k, t in enumerate(stamps_s)))
    bad = [item.reason for item in items if isinstance(item, BadFrame)]
    return [item.stamp_ns / S for item in items if isinstance(item, RgbdFrame)], bad


@pytest.mark.parametrize(
    ("stamps_s", "wrong_s"),
    [
        ((10, 11, 12, 5000, 13, 14), [5000]),
        ((1.7e9, 10, 11, 12), [1.7e9]),
        ((10, 11, 12, 600, 601, 602), []),  # the recording paused
        ((0, 1.7e9, 1.7e9 + 1, 1.7e9 + 2), []),  # no clock at first
        ((10, 130, 250, 370), []),  # one picture each two minutes
        ((10, 11, 12, 600), []),  # nothing tells that the last is wrong
        ((), []), ((10,), []),
    ],
)  # fmt: skip
def test_a_stamp_that_stands_alone_is_wrong_and_a_pause_is_none(
    stamps_s: tuple[float, ...], wrong_s: list[float]
) -> None:
    good, words = sorted_out(stamps_s)
    assert good == [t for t in stamps_s if t not in wrong_s]
    assert len(words) == len(wrong_s)
    assert all("stands alone" in word and f"{t:.3f} s" in word for word, t in zip(words, wrong_s, strict=True))


@given(st.lists(st.integers(0, 400), max_size=30))
def test_no_frame_is_lost_or_told_twice(stamps_s: list[int]) -> None:
    good, words = sorted_out(stamps_s)
    assert len(good) + len(words) == len(stamps_s)
    steps = [b - a for a, b in itertools.pairwise(stamps_s)]
    if all(0 < step * S <= JUMP_NS for step in steps):
        assert good == stamps_s


def test_bad_frames_pass_as_they_are() -> None:
    broken = BadFrame(11 * S, "torn")
    items: list[RgbdFrame | BadFrame] = [
        frame(0, 10 * S),
        broken,
        frame(1, 12 * S),
        frame(2, 900 * S),
        broken,
        frame(3, 901 * S),
        broken,
    ]
    assert [isinstance(item, BadFrame) for item in without_strays(items)] == [item is broken for item in items]


def test_a_camera_that_sends_one_good_frame_and_then_bad_ones_is_told() -> None:
    def camera() -> Iterable[RgbdFrame | BadFrame]:
        yield frame(0, 10 * S)
        while True:
            yield BadFrame(11 * S, "torn")

    items = list(itertools.islice(without_strays(camera()), 40))
    assert [isinstance(item, BadFrame) for item in items] == [False] + 39 * [True]


def test_decades_between_two_stamps_are_not_lived_through() -> None:
    hub = Hub(TreedockConfig(), SimulatedClock(0))
    context, fired = hub.context("slam"), []
    context.every(0.1, lambda: fired.append(hub.clock.now_ns()))
    hub.advance_to(1_700_000_000 * S)
    assert 2_990 <= len(fired) <= 3_010, "the last five minutes of the gap"
    assert hub.clock.now_ns() == 1_700_000_000 * S
    fired.clear()
    hub.advance_to(1_700_000_001 * S)
    assert len(fired) == 10, "and then as ever"
