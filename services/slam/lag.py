"""Depth that was not taken at the colour image's moment: looked up where the camera's motion has carried each feature.

A Kinect's colour and depth run free of each other, up to half a frame apart; at 60 degrees a second a feature is then ten
pixels from its depth. A rolling shutter's rows have moments of their own as well. To first order in time, as in ``shutter``.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.slam.camera import CameraModel, distortion_of
from services.slam.config import SlamConfig
from services.slam.depth_noise import DepthNoise
from services.slam.features import DEPTH_REACH, Features, sample_depth
from services.slam.links import Keyframes
from services.slam.motion import Velocity
from services.slam.observe import distort
from services.slam.shutter import slopes

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


class Lag:
    """Holds the depth image of the frame at hand and gives its features their depth anew as their motion gets known."""

    def __init__(self, intrinsics: Intrinsics, camera: CameraModel, config: SlamConfig, noise: DepthNoise) -> None:
        self._camera = camera.array
        self._distortion = distortion_of(intrinsics)
        self._config = config
        self._noise = noise
        self._depth_m: F32 = np.zeros((0, 0), np.float32)
        self._after_s = 0.0
        self._kept: tuple[F32, float] | None = None
        """Of a keyframe whose velocity is not known yet."""

    def begin(self, depth_m: F32, after_s: float) -> None:
        """Take a frame's depth (H, W), metres, that was taken ``after_s`` after its colour."""
        self._depth_m, self._after_s = depth_m, after_s

    def keep(self) -> None:
        """Remember the frame at hand: it became a keyframe, and nothing is known of its velocity."""
        self._kept = self._depth_m, self._after_s

    def forget(self) -> None:
        """Keep nothing: the next frame did not tell the velocity either, and no other keyframe may get this depth."""
        self._kept = None

    def settle(self, kf: Keyframes, k: int, features: Features, velocity: Velocity, readout_s: float) -> None:
        """Give keyframe ``k``, the one that was kept, its depth anew now that its velocity is known."""
        kept, self._kept = self._kept, None
        if kept is None or not self._look_up(features, kept, velocity, readout_s):
            return
        n = len(features)
        kf.depth[k, :n], kf.disparity[k, :n] = features.depth, features.disparity
        kf.info[k, :n], kf.far[k, :n] = features.info, features.far

    def look_up(self, features: Features, velocity: Velocity, readout_s: float) -> None:
        """Give features the depth they had when the middle row of the colour image was read, in place.

        ``readout_s`` the shutter's: depth is taken to be read row by row as colour is.
        """
        self._look_up(features, (self._depth_m, self._after_s), velocity, readout_s)

    def _look_up(self, features: Features, taken: tuple[F32, float], velocity: Velocity, readout_s: float) -> bool:
        """Return whether there was anything to do."""
        roll, (depth_m, after_s) = features.roll, taken
        if roll is None or after_s == readout_s == 0.0:
            return False
        config, bf = self._config, float(self._camera[4])
        back_s = np.full(len(features), -after_s)
        shift = slopes(roll.read, back_s, features.depth, self._camera, velocity.v_m_s, velocity.w_rad_s)
        place = taken_at(roll.read + shift, self._camera, self._distortion)
        depth, features.info, features.far = sample_depth(
            depth_m, place, config.min_depth_m, DEPTH_REACH * config.max_depth_m, bf, self._noise.sigma_px
        )
        before_s = after_s + readout_s * roll.row
        features.depth = carried_back(features.uv, depth, before_s, self._camera, velocity.v_m_s, velocity.w_rad_s)
        has = features.depth > 0.0
        features.disparity = np.where(has, bf / np.where(has, features.depth, 1.0), 0.0)
        return True


@njit(cache=True, nogil=True)
def taken_at(uv: F64, camera: F64, distortion: F64) -> F64:
    """Return (N, 2) where undistorted pixels are in the image as taken."""
    out = np.empty((len(uv), 2))
    for i in range(len(uv)):
        distort(uv[i, 0], uv[i, 1], camera, distortion, out[i])
    return out


@njit(cache=True, nogil=True)
def carried_back(uv: F64, depth: F64, after_s: F64, camera: F64, v: F64, w: F64) -> F64:
    """Return the depth (N,) at time zero of points that had ``depth`` (N,), 0 = none, ``after_s`` (N,) later.

    A point at X0 at time zero is at ``X0 - (v + w x X0) s`` after s seconds; ``uv`` (N, 2) is where it was at time zero.
    """
    out = np.zeros(len(depth))
    for i in range(len(depth)):
        if depth[i] <= 0.0:
            continue
        x, y = (uv[i, 0] - camera[2]) / camera[0], (uv[i, 1] - camera[3]) / camera[1]
        shrink = 1.0 - (w[0] * y - w[1] * x) * after_s[i]
        if shrink > 0.5:
            out[i] = max((depth[i] + v[2] * after_s[i]) / shrink, 0.0)
    return out
