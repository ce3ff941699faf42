"""ORB features of one image, spread evenly, with depth: what all later stages work on.

ORB: Rublee, Rabaud, Konolige and Bradski, "ORB: an efficient alternative to SIFT or SURF" (2011).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.slam.carry import Carrier
from services.slam.config import SlamConfig
from services.slam.depth_noise import DepthNoise
from services.slam.detect import EDGE_PX, Detector
from services.slam.sharpness import Sharpness

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

CELL_PX = 20.0
"""Side of the search grid's cells."""
DEPTH_REACH = 10.0
"""Depth is read up to so many times the range in which it makes map points."""
_AROUND_PX = 3
_ALIKE = 0.1
"""Share of its depth by which a pixel may differ from one beside it on the same surface."""
_VOID_PX = 16
_EMPTY_SHARE = 0.03
"""A depth image with depth in fewer of its pixels is a fault, or a view that shows nothing: what has no depth there may be anywhere."""


@dataclass(slots=True)
class Roll:
    """What the shutter did to features."""

    read: F64
    """(N, 2) undistorted pixels as they were read."""
    row: F64
    """(N,) when their row was read, as a share of the readout since the middle row's moment."""
    slope: F64
    """(N, 2) how far they belong from ``read``, pixels per second of readout."""


@dataclass(slots=True)
class Features:
    """Features of one image, in one order for all arrays (N first), with the grid that finds them by place."""

    uv: F64
    """(N, 2) undistorted pixels."""
    octave: I32
    angle: F64
    """(N,) radians."""
    desc: NDArray[np.uint64]
    """(N, 4)."""
    depth: F64
    """(N,) metres, 0 = none."""
    disparity: F64
    """(N,) fx * baseline / depth, 0 = none."""
    far: Bool
    """(N,) without depth in an area without depth: beyond the sensor's range."""
    info: F64
    """(N,) inverse variance of the disparity, 0 = none."""
    cell_start: I32
    cell_items: I32
    roll: Roll | None = None
    moving_s: F64 = field(default_factory=lambda: np.zeros(0))
    """(N,) for how long it is not to be trusted, because it was seen to move by itself; 0 for most."""
    smeared: bool = False
    """The camera moved while this image was exposed: its corners lie where the smear put them."""

    def __post_init__(self) -> None:
        if len(self.moving_s) != len(self.uv):
            self.moving_s = np.zeros(len(self.uv))

    def __len__(self) -> int:
        return len(self.uv)


@njit(cache=True, nogil=True)
def sample_depth(
    depth_m: NDArray[np.float32], xy: F64, low_m: float, high_m: float, bf: float, sigma: float
) -> tuple[F64, F64, Bool]:
    """Return depth (N,) at pixels, 0 = none, the inverse variance (N,) of ``bf / depth``, and which are far (N,).

    To the sensor's ``sigma`` comes half the range of disparities around the pixel: beside an edge, on a steep surface or
    where colour and depth were not taken at the same instant nobody knows which of them the feature has. A pixel that no
    neighbour is like is the sensor's error: it counts for none.
    """
    height, width = depth_m.shape
    out, info, far = np.zeros(len(xy)), np.zeros(len(xy)), np.zeros(len(xy), np.bool_)
    empty = is_empty(depth_m)
    for i in range(len(xy)):
        c, r = int(xy[i, 0] + 0.5), int(xy[i, 1] + 0.5)
        if c <= _AROUND_PX or r <= _AROUND_PX or c >= width - _AROUND_PX - 1 or r >= height - _AROUND_PX - 1:
            continue
        z = depth_m[r, c]
        if z <= 0.0 and not empty:
            far[i] = is_void(depth_m, c, r)
        if z < low_m or z > high_m or alone(depth_m, c, r):
            continue
        nearest = farthest = z
        for y in range(r - _AROUND_PX, r + _AROUND_PX + 1):
            for x in range(c - _AROUND_PX, c + _AROUND_PX + 1):
                other = depth_m[y, x]
                if other > 0.0 and (abs(other - z) < _ALIKE * z or not alone(depth_m, x, y)):
                    nearest, farthest = min(nearest, other), max(farthest, other)
        half = 0.5 * (bf / nearest - bf / farthest)
        out[i] = z
        info[i] = 1.0 / (sigma * sigma + half * half)
    return out, info, far


@njit(cache=True, nogil=True)
def alone(depth_m: NDArray[np.float32], c: int, r: int) -> bool:
    """Return whether fewer than two of the eight pixels around an inner pixel have a depth like its own."""
    z = depth_m[r, c]
    alike = 0
    for y in range(r - 1, r + 2):
        for x in range(c - 1, c + 2):
            alike += abs(depth_m[y, x] - z) < _ALIKE * z
    return alike < 3


@njit(cache=True, nogil=True)
def is_empty(depth_m: NDArray[np.float32]) -> bool:
    """Return whether hardly a pixel has depth (every eighth is asked, in both directions)."""
    asked = depth_m[4::8, 4::8]
    return bool(np.count_nonzero(asked > 0.0) < _EMPTY_SHARE * asked.size)


@njit(cache=True, nogil=True)
def is_void(depth_m: NDArray[np.float32], c: int, r: int) -> bool:
    """Return whether no pixel in a wide area round (c, r) has depth (every fourth is asked)."""
    height, width = depth_m.shape
    for y in range(max(r - _VOID_PX, 0), min(r + _VOID_PX + 1, height), 4):
        for x in range(max(c - _VOID_PX, 0), min(c + _VOID_PX + 1, width), 4):
            if depth_m[y, x] > 0.0:
                return False
    return True


@njit(cache=True, nogil=True)
def grid_of(uv: F64, cols: int, rows: int) -> tuple[I32, I32]:
    """Return the search grid as (cell starts, indices by cell); places outside of the image go to its border cells."""
    n = len(uv)
    cell = np.empty(n, np.int32)
    start = np.zeros(cols * rows + 1, np.int32)
    for i in range(n):
        c = min(max(int(uv[i, 0] / CELL_PX), 0), cols - 1)
        r = min(max(int(uv[i, 1] / CELL_PX), 0), rows - 1)
        cell[i] = r * cols + c
        start[cell[i] + 1] += 1
    for k in range(cols * rows):
        start[k + 1] += start[k]
    at = start[:-1].copy()
    items = np.empty(n, np.int32)
    for i in range(n):
        items[at[cell[i]]] = i
        at[cell[i]] += 1
    return start, items


def grid_size(intrinsics: Intrinsics) -> tuple[int, int]:
    """Return columns and rows of the search grid."""
    return int(np.ceil(intrinsics.width / CELL_PX)), int(np.ceil(intrinsics.height / CELL_PX))


class Extractor:
    """Makes Features of images of one camera."""

    def __init__(self, intrinsics: Intrinsics, config: SlamConfig) -> None:
        import cv2

        self._intrinsics = intrinsics
        self._config = config
        self._bf = intrinsics.fx * config.baseline_m
        self.depth_noise = DepthNoise(config.disparity_sigma_px)
        make_orb: Any = cv2.ORB_create  # type: ignore[attr-defined]  # missing from the stubs
        self._orb: Any = make_orb(
            nfeatures=config.features, scaleFactor=config.scale, nlevels=config.levels, edgeThreshold=EDGE_PX - 1
        )
        self._make_keypoint: Any = cv2.KeyPoint
        # quotas are rounded level by level
        self._detector = Detector(
            config.features - config.levels,
            config.levels,
            config.scale,
            config.fast_threshold,
            config.fast_threshold_low,
        )
        self._scales = config.scale ** np.arange(config.levels, dtype=float)
        self._K = np.array([[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]])
        self._distortion = np.array([intrinsics.k1, intrinsics.k2, intrinsics.p1, intrinsics.p2, intrinsics.k3])
        self._cols, self._rows = grid_size(intrinsics)
        self._carrier = Carrier(self._detector)
        self._sharpness = Sharpness()

    def extract(self, grey: U8, depth_m: NDArray[np.float32]) -> Features:
        """Return the features of an image (H, W) with its depth (H, W)."""
        smeared, grey = self._sharpness.judge(grey)
        searched, found = self._detector.detect(grey, depth_m)
        xy, whole, angle, octave = self._carrier.join(grey, searched, found)
        desc, kept = self._describe(searched, whole, angle, octave)
        xy, angle, octave = xy[kept], angle[kept], octave[kept]
        self._carrier.keep(grey, searched, xy, angle, octave)
        depth, info, far = sample_depth(
            depth_m, xy, self._config.min_depth_m, DEPTH_REACH * self._config.max_depth_m, self._bf, self.depth_noise.sigma_px
        )  # fmt: skip
        features = self._build(self.undistort(xy), octave, angle, desc, depth, info, far)
        features.smeared = smeared
        features.roll = Roll(features.uv, xy[:, 1] / self._intrinsics.height - 0.5, np.zeros_like(xy))
        return features

    def _describe(self, grey: U8, xy: F64, angle: F64, octave: I32) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
        """Return descriptors (M, 4) and which corners (M,) they belong to: OpenCV drops those it finds near the edge."""
        make, size, degrees = self._make_keypoint, 31.0 * self._scales[octave], np.degrees(angle) % 360.0
        keypoints = [
            make(x, y, s, a, 1.0, o, i)
            for i, (x, y, s, a, o) in enumerate(
                zip(xy[:, 0].tolist(), xy[:, 1].tolist(), size.tolist(), degrees.tolist(), octave.tolist(), strict=True)
            )
        ]
        kept, descriptors = self._orb.compute(grey, keypoints)
        if descriptors is None:
            return np.zeros((0, 4), np.uint64), np.zeros(0, np.int64)
        which = np.array([k.class_id for k in kept], np.int64)
        return np.ascontiguousarray(descriptors).view(np.uint64), which

    def undistort(self, xy: F64) -> F64:
        """Return undistorted pixels (N, 2)."""
        if not self._intrinsics.distorted or not len(xy):
            return xy
        import cv2

        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-9)
        out = cv2.undistortPoints(xy[:, None, :], self._K, self._distortion, None, None, self._K, criteria)
        return np.ascontiguousarray(out[:, 0, :])

    def _build(
        self, uv: F64, octave: I32, angle: F64, desc: NDArray[np.uint64], depth: F64, info: F64, far: Bool
    ) -> Features:
        disparity = np.where(depth > 0.0, self._bf / np.where(depth > 0.0, depth, 1.0), 0.0)
        start, items = grid_of(uv, self._cols, self._rows)
        return Features(uv, octave, angle, desc, depth, disparity, far, info, start, items)
