"""Depth from one camera into another, and images without lens distortion."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.camera.depth import kernels
from services.camera.depth.kernels import Image


def register(
    depth_m: Image, depth_camera: Intrinsics, colour_camera: Intrinsics, T_colour_depth: NDArray[np.float64]
) -> Image:
    """Return the depth image as the colour camera would see it, (H, W) of that camera, metres, zero without data.

    The depth camera's distortion is removed and the colour camera's is put in (OpenCV's model: Brown 1966): the result
    fits the colour image as it is.
    """
    x, y = _rays(depth_camera)
    c = colour_camera
    k = np.array([c.fx, c.fy, c.cx, c.cy, depth_camera.fx, c.k1, c.k2, c.p1, c.p2, c.k3, depth_camera.fy])
    out = np.empty((colour_camera.height, colour_camera.width), np.float32)
    kernels.splat(depth_m, x, y, T_colour_depth, k, out)
    return out


def undistort(image: NDArray[np.uint8], camera: Intrinsics) -> NDArray[np.uint8]:
    """Return a colour or grey image as a camera without distortion would take it, same fx fy cx cy."""
    import cv2

    map_u, map_v = _maps(camera)
    return np.asarray(cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR), dtype=np.uint8)


def undistort_depth(depth_m: Image, camera: Intrinsics) -> Image:
    """Return a depth image without distortion; depths are taken, never mixed: nearest neighbour."""
    import cv2

    map_u, map_v = _maps(camera)
    return np.asarray(cv2.remap(depth_m, map_u, map_v, cv2.INTER_NEAREST), dtype=np.float32)


def undistort_raw(depth_raw: NDArray[np.uint16], camera: Intrinsics) -> NDArray[np.uint16]:
    """As ``undistort_depth``, in raw units."""
    import cv2

    map_u, map_v = _maps(camera)
    return np.asarray(cv2.remap(depth_raw, map_u, map_v, cv2.INTER_NEAREST), dtype=np.uint16)


@lru_cache(maxsize=4)
def _maps(camera: Intrinsics) -> tuple[Image, Image]:
    import cv2

    K, distortion = _matrices(camera)
    size = (camera.width, camera.height)
    map_u, map_v = cv2.initUndistortRectifyMap(K, distortion, np.eye(3), K, size, cv2.CV_32FC1)
    return np.asarray(map_u, dtype=np.float32), np.asarray(map_v, dtype=np.float32)


@lru_cache(maxsize=4)
def _rays(camera: Intrinsics) -> tuple[Image, Image]:
    """Return (H, W) tables of x and y of each pixel's ray (x, y, 1)."""
    import cv2

    K, distortion = _matrices(camera)
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    rays = np.asarray(cv2.undistortPoints(pixels, K, distortion)).reshape(camera.height, camera.width, 2)
    return (
        np.ascontiguousarray(rays[..., 0], dtype=np.float32),
        np.ascontiguousarray(rays[..., 1], dtype=np.float32),
    )


def _matrices(camera: Intrinsics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return K, np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
