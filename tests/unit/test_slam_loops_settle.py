"""Which places a loop may be closed upon."""

from __future__ import annotations

import numpy as np
import pytest

from services.slam.features import Features
from services.slam.loops import settles
from services.slam.tracking import Tracked


def found(close: int, far: int, expected: int) -> Tracked:
    """Return a keyframe found with so many matches with and without measured depth, and as many features unmatched."""
    n = close + far
    depth = np.zeros(2 * n)
    depth[:close] = 3.0
    depth[n:] = 3.0
    features = Features(
        np.zeros((2 * n, 2)), np.zeros(2 * n, np.int32), np.zeros(2 * n), np.zeros((2 * n, 4), np.uint64), depth,
        np.where(depth > 0.0, 10.0, 0.0), depth == 0.0, np.ones(2 * n), np.zeros(1, np.int32), np.zeros(1, np.int32),
    )  # fmt: skip
    point = np.full(2 * n, -1, np.int32)
    point[:n] = np.arange(n)
    return Tracked(features, np.eye(3), np.zeros(3), point, inliers=n, expected=expected)


@pytest.mark.parametrize(
    ("close", "far", "expected", "good"),
    [
        (68, 25, 348, True),  # a true loop of a forest
        (4, 72, 1089, False),  # the same backdrop from two metres beside: it closed a loop 2.3 m wrong
        (1, 84, 200, False),  # however much of it is found again
        (60, 10, 1000, False),  # a tree that looks like another, where all else that should be seen is missing
        (30, 5, 100, False),  # too little
    ],
)
def test_far_points_alone_place_nothing(close: int, far: int, expected: int, good: bool) -> None:
    assert settles(found(close, far, expected)) is good
