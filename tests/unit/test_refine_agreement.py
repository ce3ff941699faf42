"""Depth that shows another moment than colour, or lies beside it, is noticed; good pairs are left alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from services.detector.refine.config import AgreementConfig, RefinerConfig
from services.detector.refine.kernels_colour import best_offset, edge_profiles
from services.detector.refine.model import Depth
from services.detector.refine.state import TargetState
from services.detector.refine.tracker import RefinerTracker
from tests.unit.refine_scene import CAMERA, Cone, camera_at, render, sensed

SMALL = CAMERA.model_copy(update={"width": 320, "height": 240, "fx": 250.0, "fy": 250.0, "cx": 159.5, "cy": 119.5})
CONE = Cone(2.0, 0.1, 0.1)
PERIOD_NS = 33_333_333
FRAMES = 60


def _turning(t_s: float) -> float:
    return 0.3 * math.sin(2.4 * t_s)


def _still(_: float) -> float:
    return 0.02


def _colour_of(depth: Depth, rng: np.random.Generator) -> np.ndarray:
    """Bark darker than what is behind it, both textured."""
    grey = np.where(depth < 2.3, 70.0, 150.0) + rng.normal(0.0, 12.0, depth.shape)
    return np.repeat(np.clip(grey, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2)


def _run(late_s: float, yaw: Callable[[float], float], aside_px: int = 0) -> tuple[RefinerTracker, list[TargetState]]:
    tracker = RefinerTracker(RefinerConfig())
    tracker.set_trees([CONE.expected(sigma=0.02)], [0], "m", 0)
    rng = np.random.default_rng(3)
    states = []
    for k in range(FRAMES):
        t = k * PERIOD_NS * 1e-9
        true = render([CONE], camera_at(yaw=yaw(t)), SMALL)
        late = render([CONE], camera_at(yaw=yaw(t - late_s)), SMALL) if late_s else true
        depth = np.roll(sensed(late, k), aside_px, axis=1)
        T = camera_at(yaw=yaw(t))
        states.append(tracker.step(k * PERIOD_NS, depth, SMALL, T, np.eye(6) * 1e-6, "", _colour_of(true, rng)))
    return tracker, states


def test_a_good_camera_is_left_alone() -> None:
    tracker, states = _run(0.0, _turning)
    assert tracker.camera_fault == ""
    assert sum(s.measured for s in states) >= FRAMES - 2


@pytest.mark.parametrize(("late_s", "word"), [(0.1, "older"), (-0.1, "newer")])
def test_depth_of_another_moment_is_told_and_not_believed(late_s: float, word: str) -> None:
    tracker, states = _run(late_s, _turning)
    assert f"ms {word} than the colour" in tracker.camera_fault
    told_ms = float(tracker.camera_fault.split(" ms ")[0].rsplit(" ", 1)[1])
    assert told_ms == pytest.approx(100.0, abs=25.0)
    wrong, slowest_px = 0, 0.1 * AgreementConfig().moving_px_s
    for k, state in enumerate(states):
        if state.measured:
            assert state.raw_image_x_px is not None
            bearing = math.atan2(0.1, 2.0) - _turning(k * PERIOD_NS * 1e-9)
            wrong += abs(state.raw_image_x_px - (SMALL.cx - SMALL.fx * math.tan(bearing))) > slowest_px + 3.0
    assert wrong <= 1
    assert any("older" in s.note or "newer" in s.note or "apart" in s.note for s in states)


def test_depth_beside_colour_is_told() -> None:
    tracker, _ = _run(0.0, _still, aside_px=14)
    assert "px beside colour" in tracker.camera_fault


def test_a_still_camera_says_nothing_on_time() -> None:
    tracker, states = _run(0.1, _still)
    assert tracker.camera_fault == ""
    assert all(s.measured for s in states[1:])


def test_offset_of_a_made_up_edge() -> None:
    colour = np.full((10, 400, 3), 200, np.uint8)
    colour[:, 187:247] = 40
    edges = np.array([[v, 180, 239] for v in range(10)], dtype=np.int64)
    profiles, out = np.empty((2, 97)), np.empty(3)
    assert edge_profiles(colour, edges, 48, profiles) == 20
    best_offset(profiles, AgreementConfig().widest_px, out)
    assert out[0] == pytest.approx(7.0, abs=1.0)
    assert out[2] > 3.0
