from __future__ import annotations

import numpy as np
import pytest

from services.detector.ground import find_ground
from services.detector.upright import upright_frame
from tests.unit.detector_clouds import Floats, bush, ground, trunk

UP = (0.0, 0.0, 1.0)


def _height(cloud: Floats, x: float, y: float) -> tuple[float, bool]:
    frame = upright_frame(cloud, UP)
    g = find_ground(frame, 0.5).ground
    p = frame.from_input(np.array([x, y, 0.0]))
    return g.height_m(float(p[0]), float(p[1])) + float(frame.shift[2]), g.seen


@pytest.mark.parametrize("slope", [0.0, 0.2, 0.466])
def test_slope_is_followed(slope: float) -> None:
    rng = np.random.default_rng(1)
    cloud = np.concatenate([ground(slope=slope), trunk(1.0, 1.0, 0.15, rng, z=slope)])
    cloud += rng.normal(0.0, 0.005, cloud.shape)
    for x, y in ((0.0, 0.0), (1.0, 1.0), (-3.2, 2.2)):
        z, seen = _height(cloud, x, y)
        assert seen
        assert z == pytest.approx(slope * x, abs=0.04)


def test_trunk_whose_foot_was_never_seen_does_not_lift_the_ground() -> None:
    rng = np.random.default_rng(2)
    g = ground()
    hidden = np.hypot(g[:, 0] - 1.0, g[:, 1]) < 1.2
    cloud = np.concatenate([g[~hidden], trunk(1.0, 0.0, 0.12, rng, low=0.5)])
    z, _ = _height(cloud, 1.0, 0.0)
    assert z == pytest.approx(0.0, abs=0.05)


def test_strays_below_and_bushes_above_are_passed_over() -> None:
    rng = np.random.default_rng(3)
    strays = np.stack([rng.uniform(-4, 4, 40), rng.uniform(-4, 4, 40), rng.uniform(-3, -1, 40)], axis=1)
    cloud = np.concatenate([ground(), strays, bush(1.5, 1.5, 0.6, 1.0, rng)])
    for x, y in ((0.0, 0.0), (1.5, 1.5), (-2.0, -2.0)):
        assert _height(cloud, x, y)[0] == pytest.approx(0.0, abs=0.06)


def test_cut_out_trunk_has_no_ground() -> None:
    rng = np.random.default_rng(4)
    _, seen = _height(trunk(0.0, 0.0, 0.15, rng, low=50.0, height=52.0), 0.0, 0.0)
    assert not seen


def test_normalised_heights_are_kept() -> None:
    rng = np.random.default_rng(4)
    z, seen = _height(trunk(0.0, 0.0, 0.15, rng, low=1.1, height=1.5), 0.0, 0.0)
    assert not seen
    assert z == pytest.approx(0.0, abs=1e-9)
