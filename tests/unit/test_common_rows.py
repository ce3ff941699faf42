"""Rows that grow, up to a bound, and begin anew in the room they had."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from services.common.rows import Rows

DTYPE = np.dtype([("number", np.int64), ("value", np.float64)])


@given(st.lists(st.lists(st.integers(-100, 100), max_size=700), max_size=4), st.integers(1, 600))
def test_rows_are_those_appended_since_they_began_evenly_thinned_when_too_many(
    runs: list[list[int]], most: int
) -> None:
    rows = Rows(DTYPE, most)
    for run in runs:
        rows.clear()
        for number in run:
            rows.append((number, 0.5 * number))
        step = next(2**k for k in range(12) if len(run[:: 2**k]) <= most)
        kept = run[::step]
        assert len(rows) == len(kept)
        assert rows.values["number"].tolist() == kept
        assert rows.values["value"].tolist() == [0.5 * number for number in kept]
        assert not kept or rows.last["number"] == kept[-1]


@given(st.integers(2, 300), st.integers(1, 5000))
def test_the_rows_reach_from_the_first_to_nearly_the_last(most: int, count: int) -> None:
    rows = Rows(DTYPE, most)
    for number in range(count):
        rows.append((number, 0.0))
    numbers = rows.values["number"]
    assert numbers[0] == 0
    assert min(count, most // 2) <= len(numbers) <= most
    steps = set(np.diff(numbers).tolist())
    assert len(steps) <= 1, "as dense everywhere"
    assert count - 1 - numbers[-1] < max(steps, default=2), "the end is there"


def test_what_was_taken_out_does_not_change_afterwards() -> None:
    rows = Rows(DTYPE, 10)
    rows.append((1, 1.0))
    before = rows.values
    rows.clear()
    rows.append((2, 2.0))
    assert before["number"].tolist() == [1]
