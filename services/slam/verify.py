"""Whether a found pose is believed: the whole frame has to look as the map says it should from there."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.slam.camera import CameraModel, distortion_of
from services.slam.observe import distort
from services.slam.tracking import Tracked

F64 = NDArray[np.float64]

_TOLERANCE_PX = 1.5
"""Of disparity, between the map and the depth image."""
_ENOUGH = 30
"""Points that depth has to speak of before it is listened to."""
_THROUGH_MOST = 0.5
"""Share of the points in free view that depth may see through; blind, without a last frame, half of it."""
_FEW = 60
_FOUND_LEAST = 0.08
_FOUND_LEAST_BLIND = 0.12
"""Share of the points that should be seen that are found, where fewer than ``_FEW`` are."""
_CLOSE_LEAST = 20
"""Matches with measured depth that a place needs that is found blind, or by a loop: those beyond the range tell the direction alone."""
_SURE_INLIERS = 100
_SURE_FOUND = 0.25
"""A place found blind with so many is believed at once."""


class Verifier:
    """Judges poses by the frame's depth image and by how much of the expected map was found."""

    def __init__(self, intrinsics: Intrinsics, camera: CameraModel) -> None:
        self._camera, self._distortion = camera.array, distortion_of(intrinsics)

    def believes(self, frame: Tracked, depth_m: NDArray[np.float32], *, blind: bool) -> bool:
        """Return whether a pose is fit to be published; ``blind``: found without a last frame, just before, to begin from."""
        if blind and not told_by_close(frame):
            return False
        if blind or frame.inliers < _FEW:
            least = _FOUND_LEAST_BLIND if blind else _FOUND_LEAST
            if frame.inliers < least * frame.expected:
                return False
        if frame.place is None or not len(frame.place):
            return True
        counts = np.zeros(3, np.int64)
        compare_depth(frame.place, depth_m, self._camera, self._distortion, counts)
        matched = int(np.count_nonzero((frame.point >= 0) & (frame.features.depth > 0.0)))
        agree, through = int(counts[0]) + matched, int(counts[1])
        most = 0.5 * _THROUGH_MOST if blind else _THROUGH_MOST
        return agree + through < _ENOUGH or through <= most * (agree + through)

    @staticmethod
    def sure(frame: Tracked) -> bool:
        """Return whether a place found blind needs no second frame that says the same."""
        return frame.inliers >= _SURE_INLIERS and frame.inliers >= _SURE_FOUND * frame.expected


def told_by_close(frame: Tracked) -> bool:
    """Return whether enough matches have measured depth to tell a place by."""
    close = (frame.point >= 0) & (frame.features.depth > 0.0) & ~frame.features.far
    return bool(np.count_nonzero(close) >= _CLOSE_LEAST)


@njit(cache=True, nogil=True)
def compare_depth(
    place: F64, depth_m: NDArray[np.float32], camera: F64, distortion: F64, counts: NDArray[np.int64]
) -> None:
    """Count in ``counts`` (3,) the points that depth confirms, sees through, and finds something in front of.

    ``place`` (M, 3) predicted u, v (undistorted; u NaN: not seen) and disparity, ``depth_m`` (H, W) of the frame, 0 = none,
    ``camera`` (fx, fy, cx, cy, bf), ``distortion`` (k1, k2, p1, p2, k3) of OpenCV's model.
    """
    counts[:] = 0
    height, width = depth_m.shape
    seen = np.empty(2)
    for i in range(len(place)):
        if np.isnan(place[i, 0]):
            continue
        distort(place[i, 0], place[i, 1], camera, distortion, seen)
        u, v = int(seen[0] + 0.5), int(seen[1] + 0.5)
        if u < 2 or v < 2 or u >= width - 2 or v >= height - 2:
            continue
        nearest, farthest = 0.0, 1e9
        for r in range(v - 2, v + 3, 2):
            for c in range(u - 2, u + 3, 2):
                z = depth_m[r, c]
                if z > 0.0:
                    d = camera[4] / z
                    nearest, farthest = max(nearest, d), min(farthest, d)
        if nearest == 0.0:
            continue
        if nearest < place[i, 2] - _TOLERANCE_PX:
            counts[1] += 1
        elif farthest > place[i, 2] + _TOLERANCE_PX:
            counts[2] += 1
        else:
            counts[0] += 1
