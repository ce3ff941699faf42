"""Corners of an image pyramid: found by FAST, rated by their structure tensor, spread evenly, placed below a pixel.

Rosten and Drummond, "Machine learning for high-speed corner detection" (2006); Shi and Tomasi, "Good features to track"
(1994); orientation by the intensity centroid of Rublee et al., "ORB" (2011).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

EDGE_PX = 20
"""No corner nearer to a level's edge: the descriptor's turned patch would leave the image."""
_CROWDED, _SPARSE = 8, 4
"""The threshold rises when a level has more candidates per corner wanted, and falls when it has fewer."""
_POOR = 0.5
"""Share of the corners wanted below which an image is searched again with its contrast stretched."""
_STRETCH_BLUR_PX = 1.5
_STRETCH_LEVEL = 3
"""The finest level searched in a stretched image: what is smaller is blurred away, and its corners lie where noise put them."""
_STRETCH_TO, _STRETCH_LEAST, _STRETCH_MOST = 40.0, 2.0, 8.0
"""The standard deviation of grey values that the stretched image has, and how much it is stretched at least and at most."""
_PATCH_RADIUS = 15
_TENSOR_RADIUS = 3


@njit(cache=True, nogil=True)
def corner_strength(image: U8, c: int, r: int) -> float:
    """Return the lesser eigenvalue of the structure tensor (7x7, Sobel) at a pixel."""
    a = b = d = 0.0
    for y in range(r - _TENSOR_RADIUS, r + _TENSOR_RADIUS + 1):
        for x in range(c - _TENSOR_RADIUS, c + _TENSOR_RADIUS + 1):
            left = np.int32(image[y - 1, x - 1]) + 2 * np.int32(image[y, x - 1]) + np.int32(image[y + 1, x - 1])
            right = np.int32(image[y - 1, x + 1]) + 2 * np.int32(image[y, x + 1]) + np.int32(image[y + 1, x + 1])
            top = np.int32(image[y - 1, x - 1]) + 2 * np.int32(image[y - 1, x]) + np.int32(image[y - 1, x + 1])
            low = np.int32(image[y + 1, x - 1]) + 2 * np.int32(image[y + 1, x]) + np.int32(image[y + 1, x + 1])
            gx, gy = np.int32(right - left), np.int32(low - top)
            a += gx * gx
            b += gx * gy
            d += gy * gy
    return 0.5 * (a + d - math.sqrt((a - d) ** 2 + 4.0 * b * b))


@njit(cache=True, nogil=True)
def rate(image: U8, xy: F32, depth_m: F32, scale: float) -> F64:
    """Return the strength (N,) of corners at pixels (N, 2) of a level; -1 too near to the edge.

    A corner whose pixel in the full size ``depth_m`` has data counts twice: it also tells how far.
    """
    height, width = image.shape
    out = np.full(len(xy), -1.0)
    for i in range(len(xy)):
        c, r = int(xy[i, 0]), int(xy[i, 1])
        if EDGE_PX <= c < width - EDGE_PX and EDGE_PX <= r < height - EDGE_PX:
            weight = 2.0 if depth_m[int(r * scale + 0.5), int(c * scale + 0.5)] > 0.0 else 1.0
            out[i] = weight * corner_strength(image, c, r)
    return out


@njit(cache=True, nogil=True)
def spread(xy: F32, strength: F64, keep: int, width: int, height: int) -> I64:
    """Return at most ``keep`` indices, strong and even: round by round the next best of each image cell.

    There are half as many cells as corners wanted; ties fall to the earlier index, negative strength is left out.
    """
    side = max(8.0, math.sqrt(width * height / max(0.5 * keep, 1.0)))
    cols, rows = int(width / side) + 1, int(height / side) + 1
    order = np.argsort(-strength, kind="mergesort")
    rank = np.full(len(xy), -1, np.int64)
    filled = np.zeros(cols * rows, np.int64)
    usable = 0
    for index in order:
        if strength[index] < 0.0:
            break
        cell = int(xy[index, 1] / side) * cols + int(xy[index, 0] / side)
        rank[index] = filled[cell]
        filled[cell] += 1
        usable += 1
    out = np.empty(min(keep, usable), np.int64)
    count, level = 0, 0
    while count < len(out):
        for k in range(usable):
            index = order[k]
            if rank[index] == level and count < len(out):
                out[count] = index
                count += 1
        level += 1
    return out


@njit(cache=True, nogil=True)
def place(image: U8, xy: F32, out: F64) -> None:
    """Write the places (N, 2) of corners below a pixel: the top of a parabola through the strengths beside each."""
    for i in range(len(xy)):
        c, r = int(xy[i, 0]), int(xy[i, 1])
        here = corner_strength(image, c, r)
        left, right = corner_strength(image, c - 1, r), corner_strength(image, c + 1, r)
        top, low = corner_strength(image, c, r - 1), corner_strength(image, c, r + 1)
        bend_x, bend_y = left - 2.0 * here + right, top - 2.0 * here + low
        dx = 0.5 * (left - right) / bend_x if bend_x < 0.0 else 0.0
        dy = 0.5 * (top - low) / bend_y if bend_y < 0.0 else 0.0
        out[i, 0] = c + min(max(dx, -0.5), 0.5)
        out[i, 1] = r + min(max(dy, -0.5), 0.5)


@njit(cache=True, nogil=True)
def orient(image: U8, xy: F32) -> F64:
    """Return the direction (N,), radians, from each corner to the centroid of brightness of the disc around it."""
    out = np.empty(len(xy))
    half = np.empty(2 * _PATCH_RADIUS + 1, np.int64)
    for dy in range(-_PATCH_RADIUS, _PATCH_RADIUS + 1):
        half[dy + _PATCH_RADIUS] = int(math.sqrt(_PATCH_RADIUS**2 - dy * dy))
    for i in range(len(xy)):
        c, r = int(xy[i, 0]), int(xy[i, 1])
        m10, m01 = np.int64(0), np.int64(0)
        for dy in range(-_PATCH_RADIUS, _PATCH_RADIUS + 1):
            w = half[dy + _PATCH_RADIUS]
            row = np.int64(0)
            for dx in range(-w, w + 1):
                value = np.int64(image[r + dy, c + dx])
                row += value
                m10 += dx * value
            m01 += dy * row
        out[i] = math.atan2(float(m01), float(m10))
    return out


def stretch(image: U8, least: float = _STRETCH_LEAST) -> U8 | None:
    """Return a flat image with more contrast: fog, dusk, a bare wall; None for one that is not flat (has ``least`` to gain).

    Blurred first, or the sensor's noise would make the corners. An image smeared by motion has contrast and few corners: more
    of them would lie where the smear put them.
    """
    import cv2

    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _STRETCH_BLUR_PX)
    mean, deviation = (float(value[0, 0]) for value in cv2.meanStdDev(soft))
    gain = min(_STRETCH_TO / max(deviation, 1e-6), _STRETCH_MOST)
    if gain < least:
        return None
    return np.clip(128.0 + gain * (soft - mean), 0.0, 255.0).astype(np.uint8)


def _ratio(image: U8, small: U8) -> F64:
    """Return (2,) how many pixels of an image, across and down, make one of a level, about its corner half a pixel out.

    Levels have whole pixels: the ratio is not quite the nominal one, which would be up to 2 px off at the image's far edges.
    """
    return np.array([image.shape[1] / small.shape[1], image.shape[0] / small.shape[0]])


class Detector:
    """Finds corners level by level; each level's FAST threshold follows the texture from image to image."""

    def __init__(self, corners: int, levels: int, scale: float, start: int, lowest: int) -> None:
        import cv2

        shares = scale ** -np.arange(levels, dtype=float)
        self.quota = np.round(corners * shares / shares.sum()).astype(int)
        """Corners wanted of each level."""
        self.finest_stretched = min(_STRETCH_LEVEL, levels - 1)
        coarse = np.where(np.arange(levels) >= self.finest_stretched, shares, 0.0)
        self.coarse = np.floor(corners * coarse / coarse.sum()).astype(int)
        """The same of a stretched image."""
        self.scales = scale ** np.arange(levels, dtype=float)
        self._lowest = lowest
        self._threshold = [start] * levels
        make_fast: Any = cv2.FastFeatureDetector_create  # type: ignore[attr-defined]  # missing from the stubs
        self._places_of: Any = cv2.KeyPoint_convert  # type: ignore[attr-defined]
        self._fast: list[Any] = [make_fast(start) for _ in range(levels)]

    def whole_places(self, image: U8, xy: F64, octave: NDArray[np.int32]) -> F64:
        """Return places (N, 2) of the image as ``detect`` gives them to OpenCV: whole pixels of the level times its scale."""
        size = np.array([image.shape[1], image.shape[0]])
        scale = self.scales[octave][:, None]
        ratio = size / np.round(size / scale)
        return np.asarray(np.round((xy + 0.5) / ratio - 0.5) * scale)

    def pyramid(self, image: U8) -> list[U8]:
        """Return the image at all scales, full size first."""
        import cv2

        out = [image]
        height, width = image.shape
        for s in self.scales[1:]:
            size = (round(width / s), round(height / s))
            out.append(cv2.resize(out[-1], size, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False))
        return out

    def detect(self, image: U8, depth_m: F32) -> tuple[U8, tuple[F64, F64, F64, NDArray[np.int32]]]:
        """Return the image that was searched, stretched where texture is poor, and its corners, octaves ascending.

        Places (N, 2) in the full size image, the same by OpenCV's reckoning (whole pixels of the level times its scale),
        directions (N,) and octaves (N,).
        """
        found = self._search(image, depth_m, self.quota)
        if len(found[0]) >= _POOR * self.quota.sum():
            return image, found
        stretched = stretch(image)
        return (image, found) if stretched is None else (stretched, self._search(stretched, depth_m, self.coarse))

    def _search(self, image: U8, depth_m: F32, quota: I64) -> tuple[F64, F64, F64, NDArray[np.int32]]:
        """Return up to ``quota`` (levels,) corners of each level."""
        places, whole, angles, octaves = [], [], [], []
        for level, small in enumerate(self.pyramid(image)):
            xy = self._candidates(level, small)
            strength = rate(small, xy, depth_m, self.scales[level])
            chosen = xy[spread(xy, strength, quota[level], small.shape[1], small.shape[0])]
            exact = np.empty((len(chosen), 2))
            place(small, chosen, exact)
            places.append((exact + 0.5) * _ratio(image, small) - 0.5)
            whole.append(chosen * self.scales[level])
            angles.append(orient(small, chosen))
            octaves.append(np.full(len(chosen), level, np.int32))
        return np.concatenate(places), np.concatenate(whole), np.concatenate(angles), np.concatenate(octaves)

    def _candidates(self, level: int, small: U8) -> F32:
        """Return the FAST corners (N, 2) of a level, and adapt its threshold to their number."""
        found = self._fast[level].detect(small)
        threshold = self._threshold[level]
        if len(found) < self.quota[level] and threshold > self._lowest:  # a sudden want of texture does not wait
            threshold = self._lowest
            self._fast[level].setThreshold(threshold)
            found = self._fast[level].detect(small)
        if len(found) < _SPARSE * self.quota[level]:
            threshold = max(threshold - 3, self._lowest)
        elif len(found) > _CROWDED * self.quota[level]:
            threshold = min(threshold + 1, 80)
        if threshold != self._threshold[level]:
            self._threshold[level] = threshold
            self._fast[level].setThreshold(threshold)
        return np.asarray(self._places_of(found), dtype=np.float32).reshape(-1, 2)
