"""The filters that the reference compares the bilateral one with, for ``bench depth``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]

_MIN_RANGE_M, _MAX_RANGE_M = 0.5, 6.0


def limited(depth: Image) -> Image:
    """Return the depth within the range, zero elsewhere."""
    return np.where((depth >= _MIN_RANGE_M) & (depth <= _MAX_RANGE_M), depth, np.float32(0.0))


def box(depth: Image, grey: Grey) -> Image:
    """Plain box filter: holes count as zero metres, as a filter that knows nothing of depth has it."""
    import cv2

    del grey
    depth = limited(depth)
    return np.where(depth > 0, np.asarray(cv2.blur(depth, (5, 5))), np.float32(0.0))


def mean(depth: Image, grey: Grey) -> Image:
    """Return the mean of the valid pixels in the window, where at least half of them are valid."""
    import cv2

    del grey
    depth = limited(depth)
    share = np.asarray(cv2.blur((depth > 0).astype(np.float32), (5, 5)))
    return np.where(share > 0.5, np.asarray(cv2.blur(depth, (5, 5))) / np.maximum(share, 0.04), np.float32(0.0))


def gaussian(depth: Image, grey: Grey) -> Image:
    """Gaussian filter of the valid pixels."""
    import cv2

    del grey
    depth = limited(depth)
    share = np.asarray(cv2.GaussianBlur((depth > 0).astype(np.float32), (5, 5), 1.1))
    smooth = np.asarray(cv2.GaussianBlur(depth, (5, 5), 1.1))
    return np.where(share > 0.5, smooth / np.maximum(share, 0.01), np.float32(0.0))


def median(depth: Image, grey: Grey) -> Image:
    """Median filter; holes count as zero."""
    import cv2

    del grey
    return np.asarray(cv2.medianBlur(limited(depth), 5), dtype=np.float32)
