"""Wrong intrinsics are noticed by a tree's range, which then changes while the tree passes through the image."""

from __future__ import annotations

import math

import numpy as np
import pytest

from schemas.camera import Intrinsics
from services.detector.refine.config import ConsistencyConfig, RefinerConfig
from services.detector.refine.consistency import MapConsistency
from services.detector.refine.state import TargetState
from services.detector.refine.tracker import RefinerTracker
from tests.unit.refine_scene import CAMERA, Cone, camera_at, render, sensed

TRUE = CAMERA.model_copy(update={"width": 320, "height": 240, "fx": 250.0, "fy": 250.0, "cx": 159.5, "cy": 119.5})
CONE = Cone(2.5, 0.1, 0.1)
PERIOD_NS = 66_666_667
FRAMES = 40


def _pan(told: Intrinsics, frames: int = FRAMES) -> tuple[RefinerTracker, list[TargetState]]:
    """Turn by 52 degrees past the tree with a camera that is not what is told of it."""
    tracker = RefinerTracker(RefinerConfig())
    tracker.set_trees([CONE.expected(sigma=0.03)], [0], "m", 0)
    states = []
    for k in range(frames):
        T = camera_at(yaw=-0.45 + 0.9 * k / (FRAMES - 1))
        depth = sensed(render([CONE], T, TRUE), k)
        states.append(tracker.step(k * PERIOD_NS, depth, told, T, np.eye(6) * 1e-5))
    return tracker, states


def test_the_right_camera_is_believed() -> None:
    tracker, states = _pan(TRUE)
    assert tracker.camera_fault == ""
    assert sum(s.measured for s in states) >= FRAMES - 3


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"fx": 300.0, "fy": 300.0}, "told too large"),
        ({"fx": 225.0, "fy": 225.0}, "told too small"),
    ],
)
def test_wrong_intrinsics_are_told_and_their_targets_not_believed(wrong: dict[str, float], words: str) -> None:
    tracker, states = _pan(TRUE.model_copy(update=wrong))
    assert words in tracker.camera_fault
    assert not states[-1].measured
    assert "calibrate" in states[-1].note


def test_another_camera_begins_with_a_clean_slate() -> None:
    tracker, states = _pan(TRUE.model_copy(update={"fx": 300.0, "fy": 300.0}))
    assert not states[-1].measured
    T = camera_at()
    state = tracker.step(FRAMES * PERIOD_NS, sensed(render([CONE], T, TRUE), 1), TRUE, T, np.eye(6) * 1e-5)
    assert state.measured
    assert tracker.camera_fault == ""


def _fed(
    slope: float, seed: int, *, side: float = 0.0, jump_m: float = 0.0, interrupt: bool = False, sweep: float = 0.9
) -> str:
    watch = MapConsistency(ConsistencyConfig())
    rng = np.random.default_rng(seed)
    for k in range(60):
        bearing = -0.5 * sweep + sweep * k / 59
        if interrupt and k == 30:
            watch.interrupt()
        place = np.array([3.0 + (jump_m if k >= 30 else 0.0), 0.0])
        range_m = float(np.hypot(*place)) * (
            1.0 + slope * math.sin(bearing) ** 2 + side * math.sin(bearing) + 0.0015 * rng.normal()
        )
        watch.see(k * PERIOD_NS, 1, np.array([3.0, 0.0]), np.zeros(2), bearing, range_m)
    return watch.fault


@pytest.mark.parametrize("seed", range(20))
def test_noise_is_no_fault_and_a_slope_is_one(seed: int) -> None:
    assert _fed(0.0, seed) == ""
    assert "too large" in _fed(-0.15, seed)
    assert "too small" in _fed(0.15, seed)
    assert "too far to the right" in _fed(0.0, seed, side=0.08)
    assert "too far to the left" in _fed(0.0, seed, side=-0.08)


def test_a_tree_that_stays_in_the_middle_tells_nothing() -> None:
    assert _fed(-0.5, 1, sweep=0.3) == ""


def test_a_jump_of_the_map_between_two_passes_is_no_fault() -> None:
    assert _fed(0.0, 1, jump_m=0.3)
    assert _fed(0.0, 1, jump_m=0.3, interrupt=True) == ""
