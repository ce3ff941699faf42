"""Corners of a flat image are carried on from the image before by the patch around them, not found anew.

In fog a corner found anew lies 2 px from where it was found a frame earlier (standard deviation, octaves 3 to 7, true poses
known), one followed by its patch 0.4 px: what blur has taken from a corner is its place, and a patch needs none. Lucas and
Kanade, "An iterative image registration technique" (1981), on a pyramid: Bouguet (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.slam.detect import EDGE_PX, Detector, stretch

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

Corners = tuple[F64, F64, F64, I32]
"""Places (N, 2) in the full size image, the same by OpenCV's reckoning, directions (N,), octaves (N,)."""

_WINDOW_PX = 31
"""The larger the better in fog (21 px: 0.45 px off, 31: 0.36, 41: 0.31), and the dearer; a large one also holds what lies behind."""
_COARSER = 2
"""Levels of the search, each half the size: 60 px from one image to the next are found."""
_STEPS = (3, 10, 0.03)
"""OpenCV's criterion: at most 10 steps, until one is below 0.03 px."""
_THERE_AND_BACK_PX = 0.7
"""Looked for from where it came to, at full size, a corner is at most so far from where it was."""
_MOST = 600
"""Corners carried."""
_AFTER = 6
"""Images from the last flat one on into which they are carried: what is found anew where the fog ends would lay the frame, and
the keyframes that follow, 2 to 3 cm beside where the fog was left."""
_APART_PX = 7.0
"""A corner found anew this near to a carried one is the same, times its octave's scale over the least."""


@dataclass(frozen=True, slots=True)
class _Before:
    image: U8
    flat: bool
    xy: F64
    angle: F64
    octave: I32


class Carrier:
    """Remembers the last image and its corners."""

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._before: _Before | None = None
        self._still = 0
        """Images yet to come into which corners are carried though they are clear."""

    def join(self, image: U8, searched: U8, found: Corners) -> Corners:
        """Return the corners of an image, flat where it was ``searched`` stretched: then the carried ones, and those found beside."""
        before, flat = self._before, searched is not image
        self._still = _AFTER if flat else max(self._still - 1, 0)
        if before is None or not (flat or self._still):
            return found
        earlier = before.image if before.flat else stretch(before.image, least=0.0)
        now = searched if flat else stretch(image, least=0.0)
        coarse = np.flatnonzero(before.octave >= self._detector.finest_stretched)
        if earlier is None or now is None or not len(coarse):
            return found
        if len(coarse) > _MOST:
            coarse = coarse[np.linspace(0, len(coarse) - 1, _MOST).astype(int)]
        xy, good = carried(earlier, now, before.xy[coarse])
        kept = coarse[good]
        quota = self._detector.coarse if flat else self._detector.quota
        return self._merged(searched, xy[good], before.angle[kept], before.octave[kept], found, quota)

    def keep(self, image: U8, searched: U8, xy: F64, angle: F64, octave: I32) -> None:
        """Remember an image and its corners for the next."""
        flat = searched is not image
        self._before = _Before(searched if flat else image, flat, xy, angle, octave)

    def _merged(self, searched: U8, xy: F64, angle: F64, octave: I32, found: Corners, quota: I64) -> Corners:
        """Return the carried corners, and of those found the ones that are others, as many as each level has room for."""
        scales = self._detector.scales
        fits = _first_of_each(octave, quota)
        xy, angle, octave = xy[fits], angle[fits], octave[fits]
        whole = self._detector.whole_places(searched, xy, octave)
        new = apart(xy, found[0], _APART_PX * scales[found[3]] / scales[self._detector.finest_stretched])
        room = quota - np.bincount(octave, minlength=len(scales))
        for level in np.unique(found[3]):
            of_level = np.flatnonzero(new & (found[3] == level))
            new[of_level[max(int(room[level]), 0) :]] = False
        return (
            np.concatenate([xy, found[0][new]]),
            np.concatenate([whole, found[1][new]]),
            np.concatenate([angle, found[2][new]]),
            np.concatenate([octave, found[3][new]]),
        )


def _first_of_each(octave: I32, quota: I64) -> Bool:
    """Return which of corners (N,) are within their level's quota: an image holds no more than was made room for."""
    fits = np.ones(len(octave), dtype=bool)
    for level in np.unique(octave):
        fits[np.flatnonzero(octave == level)[max(int(quota[level]), 0) :]] = False
    return fits


def carried(before: U8, now: U8, xy: F64) -> tuple[F64, Bool]:
    """Return where in ``now`` (H, W) the patches at ``xy`` (N, 2) of ``before`` (H, W) are, (N, 2), and which were found (N,)."""
    import cv2

    flow: Any = cv2.calcOpticalFlowPyrLK  # its stub wants the places that it is to find
    how = {"winSize": (_WINDOW_PX, _WINDOW_PX), "criteria": _STEPS}
    start = np.ascontiguousarray(xy, np.float32)[:, None]
    there, seen, _ = flow(before, now, start, None, maxLevel=_COARSER, **how)
    back, again, _ = flow(now, before, there, start.copy(), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **how)
    place = there[:, 0].astype(float)
    height, width = now.shape
    inside = np.all((place >= EDGE_PX) & (place < np.array([width, height]) - EDGE_PX), axis=1)
    same = np.linalg.norm(back[:, 0] - start[:, 0], axis=1) < _THERE_AND_BACK_PX
    return place, (seen[:, 0] > 0) & (again[:, 0] > 0) & same & inside


def apart(taken: F64, xy: F64, least_px: F64) -> Bool:
    """Return which of ``xy`` (N, 2) are at least ``least_px`` (N,) from each of ``taken`` (M, 2)."""
    if not len(taken) or not len(xy):
        return np.ones(len(xy), np.bool_)
    squared = (xy**2).sum(axis=1)[:, None] + (taken**2).sum(axis=1) - 2.0 * (xy @ taken.T)
    return np.asarray(squared.min(axis=1) >= least_px**2)
