"""accelerometer.txt: specific force, turned into the camera's optical frame and averaged per frame.

The file's axes are the Kinect's own: x to the left, y up, z forward, seen from behind the camera. So
``camera = (-x, -y, z)``: half a turn about the optical axis. Found by comparing the averaged samples with the true
vertical of both recordings (docs/decisions/accelerometer-axes.md); our simulator writes the same convention.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.camera import MAX_ACCEL_MPS2
from services.camera.sources.text import read_rows, stamp_ns_of
from services.common.errors import InputError

SIGNS_CAMERA_FROM_FILE = np.array([-1.0, -1.0, 1.0])
_LEAST_MPS2 = 1.0
"""Below: falling freely, or a dead sensor that sends zeros. Neither tells where up is."""
_LONGEST_WINDOW_NS = 200_000_000
"""Older samples do not describe this frame, even when frames were missed before it."""


def telling(force_mps2: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
    """Return a specific force that tells where up is, None for one that does not."""
    return force_mps2 if force_mps2 and sum(v * v for v in force_mps2) >= _LEAST_MPS2**2 else None


class Accelerometer:
    """Samples of one recording, in the camera's optical frame."""

    def __init__(self, stamps_ns: NDArray[np.int64], force_camera_mps2: NDArray[np.float64]) -> None:
        order = np.argsort(stamps_ns, kind="stable")
        self._stamps_ns = stamps_ns[order]
        self._sums = np.vstack([np.zeros(3), np.cumsum(force_camera_mps2[order], axis=0)])

    @classmethod
    def from_file(cls, path: Path) -> Accelerometer:
        """Read ``stamp ax ay az`` lines (seconds, m/s^2).

        Raises:
            InputError: naming file, line and fault.
        """
        rows = read_rows(path, columns=4, what="'stamp ax ay az'")
        stamps = [stamp_ns_of(row, 0, path) for row in rows]
        values = [[row.number(column, path) for column in (1, 2, 3)] for row in rows]
        force = np.array(values, dtype=float).reshape(-1, 3) * SIGNS_CAMERA_FROM_FILE
        for row, value in zip(rows, values, strict=True):
            if max(map(abs, value)) > MAX_ACCEL_MPS2:
                raise InputError(f"{path}:{row.line}: {value} is no acceleration in m/s^2")
        return cls(np.array(stamps, dtype=np.int64), force)

    def mean_between(self, after_ns: int, until_ns: int) -> tuple[float, float, float] | None:
        """Return the mean specific force over (after_ns, until_ns], m/s^2, camera frame; None without samples."""
        first = max(after_ns, until_ns - _LONGEST_WINDOW_NS)
        a, b = np.searchsorted(self._stamps_ns, [first, until_ns], side="right")
        if a == b:
            return None
        x, y, z = (float(v) for v in (self._sums[b] - self._sums[a]) / (b - a))
        return telling((x, y, z))
