"""How sharp an image is: whether the camera moved while it was exposed, or single pixels of it are wrong.

The variance of the Laplacian measures focus: Pech-Pacheco, Cristobal, Chamorro-Martinez and Fernandez-Valdivia, "Diatom
autofocusing in brightfield microscopy" (2000); here as a share of the image's own, so that neither light nor contrast count.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]

_REMEMBERED = 128
"""Images."""
_LEAST_REMEMBERED = 5
_USUAL_PERCENT = 25.0
"""Few of them are noisy or blank for long: the usual one is taken low."""
_SMEARED = 0.3
"""Share of the usual sharpness below which an image is smeared. A smear over 12 to 30 pixels leaves a twentieth to a seventh;
where only the view changes (turns in forests, a room with a Kinect), 99 of 100 images keep more than a third."""
_SMEARED_MOST = 30
"""So many in a row are smeared at most: then that is how it looks here."""
_NOISY = 0.5
"""Share of the image's variance: no lens draws so finely. Real recordings have 0.01 to 0.07, simulated forests 0.08 to 0.15."""


class Sharpness:
    """Remembers what is usual."""

    def __init__(self) -> None:
        self._usual: deque[float] = deque(maxlen=_REMEMBERED)
        self._run = 0

    def judge(self, grey: U8) -> tuple[bool, U8]:
        """Return whether an image (H, W) is smeared, and the image, rid of single wrong pixels when it has many."""
        import cv2

        share = sharpness(grey)
        if share > _NOISY:
            return False, np.asarray(cv2.medianBlur(grey, 3), np.uint8)
        known = len(self._usual) >= _LEAST_REMEMBERED
        smeared = known and share < _SMEARED * float(np.percentile(self._usual, _USUAL_PERCENT))
        self._run = self._run + 1 if smeared else 0
        if self._run > _SMEARED_MOST:
            self._usual.clear()
            smeared, self._run = False, 0
        if not smeared:
            self._usual.append(share)
        return smeared, grey


def sharpness(grey: U8) -> float:
    """Return the variance of an image's Laplacian as a share of its own; 0 for a blank one."""
    import cv2

    deviation = float(cv2.meanStdDev(grey)[1][0, 0])
    if deviation < 0.5:
        return 0.0
    return (float(cv2.meanStdDev(cv2.Laplacian(grey, cv2.CV_16S, ksize=1))[1][0, 0]) / deviation) ** 2
