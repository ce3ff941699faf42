"""The residual picture: where corners were seen, how far they are from where the camera puts them, picture by picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.camera.calibration.judge import Limits, Result, scale

Colour = tuple[int, int, int]

_INK, _FAINT, _BAD, _GOOD = (40, 40, 40), (205, 205, 205), (40, 40, 200), (60, 140, 40)
_MAP_PX = 720
_SIDE_PX = 360
_BAR_PX = 150
_HEAD_PX = 60


def residual_picture(result: Result, limits: Limits, title: str) -> NDArray[np.uint8]:
    """Return a (H, W, 3) BGR picture of a solved calibration."""
    import cv2

    assert result.solution is not None
    width, height = result.solution.size_px
    shrink = _MAP_PX / width
    map_height = round(height * shrink)
    canvas = np.full((_HEAD_PX + max(map_height, _SIDE_PX) + _BAR_PX, _MAP_PX + _SIDE_PX + 60, 3), 255, np.uint8)
    verdict = "PASS" if result.passed else "FAIL"
    s = result.solution
    _text(canvas, (20, 24), f"{verdict}  {title}", _GOOD if result.passed else _BAD, 0.6)
    _text(canvas, (20, 48), f"fx {s.K[0, 0]:.1f}  fy {s.K[1, 1]:.1f}  cx {s.K[0, 2]:.1f}  cy {s.K[1, 2]:.1f}   "
          f"{len(s.views)} pictures, reprojection {s.rms_px:.3f} px", _INK, 0.5)  # fmt: skip
    magnified = _draw_map(canvas[_HEAD_PX : _HEAD_PX + map_height, 20 : 20 + _MAP_PX], result, shrink)
    side = canvas[_HEAD_PX : _HEAD_PX + _SIDE_PX, 40 + _MAP_PX : 40 + _MAP_PX + _SIDE_PX]
    _draw_scatter(side, result, limits)
    top = _HEAD_PX + max(map_height, _SIDE_PX)
    _text(canvas, (20, top + 18), f"residuals {magnified:.0f} times enlarged, cells without a corner grey", _INK, 0.45)
    _draw_bars(canvas[top + 30 : top + _BAR_PX - 8, 20:-20], result, limits)
    cv2.rectangle(canvas, (20, _HEAD_PX), (19 + _MAP_PX, _HEAD_PX + map_height - 1), _INK, 1)
    return canvas


def _draw_map(part: NDArray[np.uint8], result: Result, shrink: float) -> float:
    """Draw residuals where the corners are; returns by how much they are enlarged."""
    import cv2

    assert result.solution is not None
    rows, columns = result.coverage.cells.shape
    for row in range(rows):
        for column in range(columns):
            if result.coverage.cells[row, column] == 0:
                y = [round(part.shape[0] * k / rows) for k in (row, row + 1)]
                x = [round(part.shape[1] * k / columns) for k in (column, column + 1)]
                part[y[0] : y[1], x[0] : x[1]] = 232
    usual = float(np.percentile(np.linalg.norm(result.solution.residuals_px, axis=1), 90))
    magnified = 18.0 / max(usual, 1e-3) / shrink
    for view in result.solution.views:
        begin = view.sighting.points_px * shrink
        end = begin + view.residuals_px * magnified * shrink
        for a, b in zip(begin, end, strict=True):
            cv2.line(part, _at(a), _at(b), (200, 120, 40), 1, cv2.LINE_AA)
            cv2.circle(part, _at(a), 1, _INK, -1, cv2.LINE_AA)
    return magnified


def _draw_scatter(part: NDArray[np.uint8], result: Result, limits: Limits) -> None:
    """Draw all residuals about zero, with the limit as a circle: a good calibration is a round cloud."""
    import cv2

    assert result.solution is not None
    residuals = result.solution.residuals_px
    limit = scale(result.solution.size_px[0]) * limits.rms_px
    reach = max(2.0 * limit, float(np.percentile(np.abs(residuals), 99)))
    centre, per_px = _SIDE_PX // 2, 0.47 * _SIDE_PX / reach
    cv2.line(part, (0, centre), (_SIDE_PX, centre), _FAINT, 1)
    cv2.line(part, (centre, 0), (centre, _SIDE_PX), _FAINT, 1)
    for x, y in residuals:
        cv2.circle(part, _at((centre + per_px * x, centre + per_px * y)), 1, (200, 120, 40), -1, cv2.LINE_AA)
    cv2.circle(part, (centre, centre), round(per_px * limit), _BAD, 1, cv2.LINE_AA)
    _text(part, (6, 16), f"circle: {limit:.2f} px", _BAD, 0.45)
    cv2.rectangle(part, (0, 0), (_SIDE_PX - 1, _SIDE_PX - 1), _INK, 1)


def _draw_bars(part: NDArray[np.uint8], result: Result, limits: Limits) -> None:
    """Draw each picture's error as a bar, with the limit as a line."""
    import cv2

    assert result.solution is not None
    height, width = part.shape[:2]
    limit = scale(result.solution.size_px[0]) * limits.rms_px
    errors = [view.rms_px for view in result.solution.views]
    per_px = (height - 18) / max(1.2 * limit, max(errors))
    step = min(width / len(errors), 48.0)
    for k, error in enumerate(errors):
        x = round(k * step)
        colour: Colour = _BAD if error > limit else (200, 120, 40)
        top = height - 16 - round(per_px * error)
        cv2.rectangle(part, (x + 2, top), (x + round(step) - 3, height - 16), colour, -1)
        if step >= 18:
            _text(part, (x + 3, height - 3), str(result.solution.views[k].number + 1), _INK, 0.38)
    y = height - 16 - round(per_px * limit)
    cv2.line(part, (0, y), (width, y), _BAD, 1)
    _text(part, (width - 150, max(y - 4, 10)), f"limit {limit:.2f} px", _BAD, 0.42)


def _at(point: NDArray[np.float64] | tuple[float, float]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def _text(image: NDArray[np.uint8], at: tuple[int, int], text: str, colour: Colour, size: float) -> None:
    import cv2

    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
