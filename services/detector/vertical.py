"""The vertical of a cloud that does not say: the axes are tried, then the ground's own normal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.detector.config import DetectorConfig
from services.detector.detect import detect_trees
from services.detector.model import DetectionResult

Up = tuple[float, float, float]

_AXES: tuple[tuple[Up, str], ...] = (
    ((0.0, 0.0, 1.0), "z up"), ((0.0, 1.0, 0.0), "y up"), ((0.0, -1.0, 0.0), "y down"), ((1.0, 0.0, 0.0), "x up"),
    ((-1.0, 0.0, 0.0), "x down"), ((0.0, 0.0, -1.0), "z down"),
)  # fmt: skip
_SAMPLE = 300_000
_LEANS_RAD = 0.17
"""Trunks of a whole cloud do not lean 10 degrees one way."""
_AGREE = 3
_BETTER = 1.5
"""z is left only for a direction that is so many times better."""


@dataclass(frozen=True, slots=True)
class Vertical:
    """The chosen direction, and the words that tell how it was found."""

    up: Up
    how: str
    score: float = 0.0
    """How much like trees on ground the cloud looks that way; 0: not at all."""
    median_radius_m: float = 0.0
    """Of the trunks that show that way."""


def find_vertical(points_m: NDArray[np.float64], config: DetectorConfig | None = None) -> Vertical:
    """Return the direction in which the cloud looks most like trees on ground; z when none does."""
    sample = np.ascontiguousarray(points_m[:: max(1, len(points_m) // _SAMPLE)])
    looks = [(detect_trees(sample, up, None, config), up, name) for up, name in _AXES]
    scores = [_score(result) / (1.0 if up[2] == 1.0 else _BETTER) for result, up, _ in looks]
    best = int(np.argmax(scores))
    result, up, name = looks[best]
    if scores[best] > 0.0:
        swapped = "" if up[2] == 1.0 else "the axes are swapped, "
        upright = _found(result, up, f"{swapped}{name}: most trunks stand that way")
        return _tilted(sample, result, upright, config) or upright
    normal = ground_normal(sample)
    if normal is not None:
        result = detect_trees(sample, normal, None, config)
        if _score(result) > 0.0:
            level = _found(result, normal, "the normal of the largest plane, on which trunks stand")
            return _tilted(sample, result, level, config) or level
    return Vertical((0.0, 0.0, 1.0), "z up is assumed: no direction shows a trunk")


def _tilted(
    sample: NDArray[np.float64], result: DetectionResult, upright: Vertical, config: DetectorConfig | None
) -> Vertical | None:
    """Return the common direction of the trunks where all lean one way: the scanner did not stand level, the trees do.

    Three trunks that agree tell it; fewer, or the normal of the ground, only where that way shows much more of trees.
    """
    if _lean_rad(result) < _LEANS_RAD:
        return None
    starts = [_common_axis(result)]
    normal = ground_normal(sample)
    if normal is not None:
        starts.append(_common_axis(detect_trees(sample, normal, None, config)) or normal)
    best: Vertical | None = None
    for up in starts:
        looked = detect_trees(sample, up, None, config) if up is not None else None
        if looked is None or not looked.trunks:
            continue
        needed = 0.95 if len(result.trunks) >= _AGREE and up == starts[0] else _BETTER
        if _score(looked) >= needed * max(upright.score, best.score if best else 0.0):
            best = _found(looked, up or upright.up, "the axes are tilted: trunks stand in this direction")
    return best


def _common_axis(result: DetectionResult) -> Up | None:
    """Return the mean direction of the trunks; None when there are none."""
    if not result.trunks:
        return None
    mean = np.mean([np.array(t.axis) * t.confidence for t in result.trunks], axis=0)
    x, y, z = (float(v) for v in mean / max(float(np.linalg.norm(mean)), 1e-9))
    return x, y, z


def _lean_rad(result: DetectionResult) -> float:
    """Return the angle between the direction that was taken for up and the trunks' common one."""
    axis = _common_axis(result)
    return 0.0 if axis is None else float(np.arccos(min(1.0, float(np.dot(axis, result.up)))))


def _found(result: DetectionResult, up: Up, how: str) -> Vertical:
    return Vertical(up, how, _score(result), float(np.median([t.radius_m for t in result.trunks])))


def _score(result: DetectionResult) -> float:
    """Trunks count by confidence; double on ground that is seen, which tells up from down."""
    return sum(t.confidence for t in result.trunks) * (2.0 if result.ground.seen else 1.0)


def ground_normal(points_m: NDArray[np.float64], trials: int = 200) -> Up | None:
    """Return the unit normal of the plane that holds most points (RANSAC), on the side of most other points."""
    rng = np.random.default_rng(1)
    P = points_m[:: max(1, len(points_m) // 20_000)]
    best, count = None, 0
    for _ in range(trials):
        a, b, c = P[rng.integers(0, len(P), 3)]
        n = np.cross(b - a, c - a)
        length = float(np.linalg.norm(n))
        if length < 1e-9:
            continue
        d = (P - a) @ (n / length)
        on = int(np.count_nonzero(np.abs(d) < 0.05))
        if on > count:
            off = d[np.abs(d) >= 0.05]
            side = -1.0 if len(off) and float(np.median(off)) < 0.0 else 1.0
            best, count = side * n / length, on
    return None if best is None else (float(best[0]), float(best[1]), float(best[2]))
