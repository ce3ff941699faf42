"""A picture per candidate, kept or dropped: from above at trunk height, and from the side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.detector.model import DetectionResult, Floats
from services.detector.upright import Upright, upright_frame

_SIZE = 420
_ABOVE_M = 0.6
"""Half the width of the view from above, at least."""
_SIDE_M = 1.6
_UP_M = (-0.2, 3.0)
_SLICE_M = (0.3, 2.2)
_INK, _GOOD, _BAD, _GROUND = (60, 60, 60), (40, 140, 40), (40, 40, 200), (150, 190, 220)


@dataclass(frozen=True, slots=True)
class _Candidate:
    name: str
    base_m: Floats
    """(3,) upright frame."""
    slope: Floats
    """(2,): dx/dz, dy/dz; zero where the lean is not known."""
    radius_m: float
    lines: tuple[str, str]
    good: bool


def draw_candidates(folder: Path, points_m: NDArray[np.floating], result: DetectionResult) -> list[Path]:
    """Write ``kept-001.png`` and ``dropped-001.png`` and so on; return the files.

    Raises:
        InputError: the folder cannot be written.
    """
    import cv2

    frame = upright_frame(points_m, result.up)
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--pictures {folder}: cannot be written: {error.strerror}") from error
    for candidate in _candidates(frame, result):
        path = folder / candidate.name
        if not cv2.imwrite(str(path), _picture(frame, result, candidate)):
            raise InputError(f"--pictures {folder}: {candidate.name} cannot be written")
        paths.append(path)
    return paths


def _candidates(frame: Upright, result: DetectionResult) -> list[_Candidate]:
    out: list[_Candidate] = []
    for k, t in enumerate(result.trunks, start=1):
        words = f"r {100 * t.radius_m:.1f} cm, arc {np.degrees(t.arc_rad):.0f} deg, confidence {t.confidence:.2f}"
        axis = frame.R @ np.array(t.axis)
        place = frame.from_input(np.array(t.base_m))
        lines = (words, t.remark or "suitable")
        out.append(_Candidate(f"kept-{k:03d}.png", place, axis[:2] / axis[2], t.radius_m, lines, good=True))
    for k, r in enumerate(result.rejections, start=1):
        place = frame.from_input(np.array([r.x_m, r.y_m, r.z_m]))
        lines = (f"r {100 * r.radius_m:.1f} cm, {r.layers} slices", r.reason)
        out.append(_Candidate(f"dropped-{k:03d}.png", place, np.zeros(2), r.radius_m, lines, good=False))
    return out


def _picture(frame: Upright, result: DetectionResult, candidate: _Candidate) -> NDArray[np.uint8]:
    import cv2

    base, radius = candidate.base_m, candidate.radius_m
    near = np.hypot(frame.xyz_m[:, 0] - base[0], frame.xyz_m[:, 1] - base[1]) < _SIDE_M
    p = frame.xyz_m[near].astype(np.float64)
    p = p[:: max(1, len(p) // 60_000)]
    height = p[:, 2] - result.ground.heights_m(p[:, :2]) if len(p) else np.zeros(0)
    d = p[:, :2] - base[:2]
    wide = max(_ABOVE_M, 2.5 * radius)
    slab = (height > _SLICE_M[0]) & (height < _SLICE_M[1])
    straight = d[slab] - height[slab, None] * candidate.slope  # a leaning trunk is seen along its axis
    above = _panel(straight, (-wide, wide), (-wide, wide), np.zeros(len(straight)))
    colour = _GOOD if candidate.good else _BAD
    cv2.circle(above, (_SIZE // 2, _SIZE // 2), max(1, round(radius * _SIZE / (2.0 * wide))), colour, 1, cv2.LINE_AA)
    side = _panel(np.column_stack([d[:, 0], height]), (-_SIDE_M, _SIDE_M), _UP_M, (np.abs(height) < 0.1).astype(float))
    for edge in (-radius, radius):
        foot, head = (_pixel(edge + float(candidate.slope[0]) * h, h) for h in _SLICE_M)
        cv2.line(side, foot, head, colour, 1, cv2.LINE_AA)
    words = np.full((46, 2 * _SIZE, 3), 255, dtype=np.uint8)
    for row, text in enumerate(candidate.lines):
        ink = _INK if row == 0 else colour
        cv2.putText(words, text, (6, 17 + 20 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, ink, 1, cv2.LINE_AA)
    return np.vstack([words, np.hstack([above, side])])


def _pixel(across_m: float, height_m: float) -> tuple[int, int]:
    """Return the pixel of a place in the view from the side."""
    u = (across_m + _SIDE_M) / (2.0 * _SIDE_M) * _SIZE
    return round(u), round((_UP_M[1] - height_m) / (_UP_M[1] - _UP_M[0]) * _SIZE)


def _panel(
    points: Floats, across: tuple[float, float], up: tuple[float, float], ground: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return a white square with a dot per point."""
    image = np.full((_SIZE, _SIZE, 3), 255, dtype=np.uint8)
    u = ((points[:, 0] - across[0]) / (across[1] - across[0]) * _SIZE).astype(np.int64)
    v = ((up[1] - points[:, 1]) / (up[1] - up[0]) * _SIZE).astype(np.int64)
    inside = (u >= 0) & (u < _SIZE) & (v >= 0) & (v < _SIZE)
    image[v[inside], u[inside]] = np.where(ground[inside, None] > 0.5, _GROUND, _INK)
    image[[0, -1]], image[:, [0, -1]] = 200, 200
    return image
