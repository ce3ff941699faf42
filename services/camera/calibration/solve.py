"""From sightings to a camera: OpenCV's model with k1 k2 p1 p2 k3 (Zhang 2000; Brown 1966), pictures that do not fit left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.camera.calibration.board import Board, Sighting

Floats = NDArray[np.float64]

_LEAST_VIEWS = 4
_MISFIT = 3.0
"""A picture whose residuals are so many times the median's is left out (moved while exposed, or a bent board)."""
_MISFIT_FLOOR_PX = 0.15
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class View:
    """One picture's part in the solution."""

    number: int
    """Of the sighting, as it was given."""
    sighting: Sighting
    T_camera_board: Floats
    """(4, 4): points of the board, about its centre, in the camera."""
    residuals_px: Floats
    """(N, 2): found minus projected."""

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))

    @property
    def tilt_rad(self) -> float:
        """Angle between the board's normal and the line of sight to its centre."""
        centre = self.T_camera_board[:3, 3]
        cosine = abs(float(self.T_camera_board[:3, 2] @ centre)) / max(float(np.linalg.norm(centre)), 1e-9)
        return float(np.arccos(min(cosine, 1.0)))


@dataclass(frozen=True, slots=True)
class Solution:
    """A calibrated camera."""

    size_px: tuple[int, int]
    """Width, height."""
    K: Floats
    distortion: Floats
    """k1 k2 p1 p2 k3."""
    sigma: Floats
    """Standard deviations of fx fy cx cy k1 k2 p1 p2 k3."""
    views: tuple[View, ...]
    left_out: tuple[int, ...]
    """Numbers of the pictures that did not fit."""

    @property
    def rms_px(self) -> float:
        """Root mean square reprojection error over all corners."""
        return float(np.sqrt(np.mean(np.sum(self.residuals_px**2, axis=1))))

    @property
    def residuals_px(self) -> Floats:
        """Residuals (N, 2) of all pictures."""
        return np.concatenate([view.residuals_px for view in self.views])


def solve(sightings: Sequence[Sighting], board: Board, size_px: tuple[int, int]) -> Solution | None:
    """Return the camera that explains the sightings, None with too few or where no camera does."""
    kept = list(range(len(sightings)))
    solution = None
    for _ in range(_ROUNDS):
        if len(kept) < _LEAST_VIEWS:
            return solution
        solution = _solve(sightings, kept, board, size_px)
        if solution is None:
            return None
        rms = np.array([view.rms_px for view in solution.views])
        limit = max(_MISFIT * float(np.median(rms)), _MISFIT_FLOOR_PX)
        fit = [view.number for view in solution.views if view.rms_px <= limit]
        if len(fit) == len(kept):
            return solution
        kept = fit
    return solution


def _solve(
    sightings: Sequence[Sighting], kept: Sequence[int], board: Board, size_px: tuple[int, int]
) -> Solution | None:
    import cv2

    points_m = board.points_m()
    objects = [points_m[sightings[k].ids].astype(np.float32) for k in kept]
    images = [sightings[k].points_px.astype(np.float32)[:, None] for k in kept]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    try:
        _, K, coefficients, rotations, shifts, sigma, _, _ = cv2.calibrateCameraExtended(
            objects, images, size_px, np.eye(3), np.zeros(5), flags=0, criteria=criteria
        )
    except cv2.error:
        return None
    if not np.all(np.isfinite(K)) or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        return None
    distortion = np.ravel(coefficients)[:5].astype(np.float64)
    views = []
    for k, rotation, shift, image in zip(kept, rotations, shifts, images, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.asarray(cv2.Rodrigues(rotation)[0]), np.ravel(shift)
        projected, _ = cv2.projectPoints(points_m[sightings[k].ids], rotation, shift, K, distortion)
        residuals = image[:, 0].astype(np.float64) - np.asarray(projected).reshape(-1, 2)
        views.append(View(k, sightings[k], T, residuals))
    left_out = tuple(k for k in range(len(sightings)) if k not in set(kept))
    return Solution(
        size_px, np.asarray(K, dtype=np.float64), distortion, np.ravel(sigma)[:9].astype(np.float64), tuple(views),
        left_out,
    )  # fmt: skip


def board_pose(sighting: Sighting, board: Board, K: Floats, distortion: Floats) -> Floats | None:
    """Return ``T_camera_board`` (4, 4) of one picture with a known camera, None where it has none."""
    import cv2

    found, rotation, shift = cv2.solvePnP(board.points_m()[sighting.ids], sighting.points_px, K, distortion)
    if not found:
        return None
    rotation, shift = cv2.solvePnPRefineLM(
        board.points_m()[sighting.ids], sighting.points_px, K, distortion, rotation, shift
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(cv2.Rodrigues(rotation)[0]), np.ravel(shift)
    return T
