"""The vertical of clouds whose axes are swapped or tilted."""

from __future__ import annotations

import numpy as np
import pytest

from services.common.geometry import exp_rotation
from services.detector.vertical import find_vertical
from tests.unit.detector_clouds import Floats, ground, trunk

PLACES = ((2.0, 0.5, 0.12), (-1.0, 2.0, 0.08), (0.0, -3.0, 0.15), (-2.5, -1.5, 0.10))


def _stand(lean: tuple[float, float] = (0.0, 0.0)) -> Floats:
    rng = np.random.default_rng(3)
    cloud = np.concatenate([ground(), *(trunk(x, y, r, rng, lean=lean) for x, y, r in PLACES)])
    return np.asarray(cloud + rng.normal(0.0, 0.003, cloud.shape))


@pytest.mark.parametrize("tilt_deg", [20.0, 30.0, 45.0])
def test_a_tilted_cloud_is_righted_by_its_trunks(tilt_deg: float) -> None:
    turn = exp_rotation(np.radians(tilt_deg) * np.array([0.8, -0.6, 0.0]))
    found = find_vertical(_stand() @ turn.T)
    assert np.degrees(np.arccos(np.dot(found.up, turn @ [0.0, 0.0, 1.0]))) < 2.0


@pytest.mark.parametrize("lean", [(0.0, 0.0), (0.06, 0.0)])
def test_trunks_that_lean_a_little_leave_z_alone(lean: tuple[float, float]) -> None:
    assert find_vertical(_stand(lean)).up == (0.0, 0.0, 1.0)
