"""What lies beyond the sensor's range: believed to be somewhere while the camera turns, told by parallax when it goes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from services.common.geometry import inverse, level_camera
from services.slam.config import SlamConfig
from services.slam.far import FarPrior
from services.slam.slam import Slam
from tests.unit.slam_room import INTRINSICS, look

RANGE_M = 2.6
BF = 40.0


def test_the_farther_keyframes_stand_apart_the_less_is_believed() -> None:
    prior = FarPrior(16.0, 0.02)
    at_one_place, apart, far_apart = (prior.disparity(BF, span_m) for span_m in (1.9, 2.3, 4.0))
    assert at_one_place[0] == apart[0] == far_apart[0] == pytest.approx(BF / 16.0)
    assert 1.0 / math.sqrt(at_one_place[1]) == pytest.approx(BF * 0.02)
    assert at_one_place[1] > apart[1] > 20.0 * far_apart[1]


def test_a_walk_is_as_long_as_it_is_where_most_lies_beyond_the_range() -> None:
    """The walls are up to 5 m off, what has no depth is believed to be at 16: three times as far as it is."""
    slam = Slam(INTRINSICS, SlamConfig(features=600, max_depth_m=RANGE_M))
    way = [level_camera([-2.5 + 0.04 * k, 0.05 * math.sin(0.4 * k), -0.9], 0.1 * math.sin(0.2 * k)) for k in range(60)]
    found = []
    for k, T in enumerate(way):
        grey, depth_m = look(T)
        depth_m[depth_m > RANGE_M] = 0.0
        result = slam.track(1 + k * 66_000_000, grey, depth_m)
        assert result.T_map_camera is not None
        found.append(inverse(slam.mapping.keyframe_pose(0)) @ result.T_map_camera)
    true = [inverse(way[0]) @ T for T in way]
    far = np.count_nonzero(slam.atlas.points.parallax[slam.atlas.points.n > 0] >= 0.0)
    assert far > 200
    length_m, true_m = (float(np.linalg.norm(Ts[-1][:3, 3] - Ts[0][:3, 3])) for Ts in (found, true))
    assert length_m == pytest.approx(true_m, rel=0.1)  # 13 % too long by the belief as it is on the spot
