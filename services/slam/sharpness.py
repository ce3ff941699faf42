"""How sharp an image is: whether the camera moved while it was exposed, or single pixels of it are wrong.

A smear takes the detail away along its direction and leaves what lies across: the lesser eigenvalue of the image's mean
structure tensor falls, as a share of the image's variance, so that neither light nor contrast count. Structure tensor: Bigun
and Granlund, "Optimal orientation detection of linear symmetry" (1987). Noise is told by the Laplacian's variance.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numba import njit
from numpy.typing import NDArray

U8 = NDArray[np.uint8]

_REMEMBERED = 128
"""Images."""
_LEAST_REMEMBERED = 5
_USUAL_PERCENT = 25.0
"""Few of them are noisy or blank for long: the usual one is taken low."""
_SMEARED = 0.3
"""Share of the usual below which an image is smeared. A smear over 12 to 30 pixels leaves 0.05 to 0.22; of turns in forests
and of real recordings by hand no image has less than 0.31 for another reason."""
_SMEARED_MOST = 30
"""So many in a row are smeared at most: then that is how it looks here."""
_NOISY, _NOISY_TIMES = 0.5, 2.0
"""Laplacian's share of the variance, and times the usual, that make an image noisy. Real recordings have 0.01 to 0.07, forests
rendered at half size 0.08 to 0.15, at full size 1.3 to 1.7: pixel by pixel they are as fine as noise, and rain adds 4."""
_BLANK = 0.25
"""Variance."""


class Sharpness:
    """Remembers what is usual."""

    def __init__(self) -> None:
        self._details: deque[float] = deque(maxlen=_REMEMBERED)
        self._noises: deque[float] = deque(maxlen=_REMEMBERED)
        self._run = 0

    def judge(self, grey: U8) -> tuple[bool, U8]:
        """Return whether an image (H, W) is smeared, and the image, rid of single wrong pixels when it has many."""
        detail, noise = sharpness(grey)
        known = len(self._details) >= _LEAST_REMEMBERED
        if known and noise > max(_NOISY, _NOISY_TIMES * _usual(self._noises)):
            import cv2

            return False, np.asarray(cv2.medianBlur(grey, 3), np.uint8)
        smeared = known and detail < _SMEARED * _usual(self._details)
        self._run = self._run + 1 if smeared else 0
        if self._run > _SMEARED_MOST:
            self._details.clear()
            self._noises.clear()
            smeared, self._run = False, 0
        if not smeared:
            self._details.append(detail)
            self._noises.append(noise)
        return smeared, grey


def _usual(remembered: deque[float]) -> float:
    return float(np.percentile(remembered, _USUAL_PERCENT))


@njit(cache=True, nogil=True)
def sharpness(grey: U8) -> tuple[float, float]:
    """Return the least detail in any direction and the Laplacian's, both as shares of the image's variance; every second row."""
    height, width = grey.shape
    total = squares = xx = yy = xy = lap2 = np.int64(0)
    for r in range(1, height - 1, 2):
        for c in range(1, width - 1):
            here = np.int32(grey[r, c])
            left, right = np.int32(grey[r, c - 1]), np.int32(grey[r, c + 1])
            top, low = np.int32(grey[r - 1, c]), np.int32(grey[r + 1, c])
            dx, dy, lap = right - left, low - top, left + right + top + low - 4 * here
            total += here
            squares += here * here
            xx += dx * dx
            yy += dy * dy
            xy += dx * dy
            lap2 += lap * lap
    count = max(((height - 1) // 2) * (width - 2), 1)
    variance = max(squares / count - (total / count) ** 2, _BLANK)
    least = 0.5 * (xx + yy - math.hypot(float(xx - yy), 2.0 * xy))
    return least / count / variance, lap2 / count / variance
