"""ROS image messages (sensor_msgs Image, CompressedImage, CameraInfo of ROS 1 and 2) to our arrays."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.camera.codecs import FrameError, decode_colour_image, decode_depth_image

COLOUR_KINDS = ("bgr8", "rgb8", "bgra8", "rgba8", "mono8", "8UC1", "8UC3")
DEPTH_KINDS = ("16UC1", "mono16", "32FC1")
MILLIMETRES = 1000.0
"""Units per metre of 16UC1 (REP 118)."""
_FLOAT_SCALE = 5000.0
"""Metres (32FC1) become units of 0.2 mm: 13 m at most."""
_DEPTH_HEADER = struct.Struct("<iff")
"""Before a compressedDepth image: format, and the two parameters of its quantisation."""
_PLAIN_MODELS = ("plumb_bob", "rational_polynomial", "radial-tangential", "")

RosMessage = Any
"""rosbags makes the message classes at run time from what the bag says they are."""


def kind_of(message: RosMessage) -> str:
    """Return ``colour``, ``depth`` or nothing, by an image message's own encoding."""
    if hasattr(message, "encoding"):
        return "depth" if message.encoding in DEPTH_KINDS else "colour" if message.encoding in COLOUR_KINDS else ""
    form = str(message.format).lower()
    if "compresseddepth" in form or form.startswith(("16uc1", "32fc1", "mono16")):
        return "depth"
    return "colour" if any(word in form for word in ("jpeg", "jpg", "png")) else ""


def colour_of(message: RosMessage, width: int, height: int) -> NDArray[np.uint8]:
    """Return (H, W, 3) uint8 BGR.

    Raises:
        FrameError: damaged, of another size, or of an unknown encoding.
    """
    if not hasattr(message, "encoding"):
        return decode_colour_image(bytes(message.data), width, height)
    import cv2

    name = str(message.encoding)
    if name not in COLOUR_KINDS:
        raise FrameError(f"colour image of encoding {name!r}, expected one of {', '.join(COLOUR_KINDS)}")
    channels = 1 if name in ("mono8", "8UC1") else 4 if name in ("bgra8", "rgba8") else 3
    pixels = _pixels(message, np.dtype(np.uint8), channels, (width, height), "colour")
    codes = {
        "rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR,
        "mono8": cv2.COLOR_GRAY2BGR, "8UC1": cv2.COLOR_GRAY2BGR,
    }  # fmt: skip
    return np.asarray(cv2.cvtColor(pixels, codes[name]) if name in codes else pixels, dtype=np.uint8)


def depth_of(message: RosMessage, width: int, height: int) -> tuple[NDArray[np.uint16], float]:
    """Return (H, W) uint16 raw depth and its units per metre.

    Raises:
        FrameError: damaged, of another size, or of an unknown encoding.
    """
    if not hasattr(message, "encoding"):
        return _compressed_depth(message, width, height)
    name = str(message.encoding)
    if name not in DEPTH_KINDS:
        raise FrameError(f"depth image of encoding {name!r}, expected one of {', '.join(DEPTH_KINDS)}")
    if name != "32FC1":
        return _pixels(message, np.dtype(np.uint16), 1, (width, height), "depth").astype(np.uint16), MILLIMETRES
    return _from_metres(_pixels(message, np.dtype(np.float32), 1, (width, height), "depth")), _FLOAT_SCALE


def intrinsics_of(info: RosMessage, topic: str, depth_scale: float) -> Intrinsics:
    """Return a CameraInfo's intrinsics; of a rectified image (by its topic's name) the projection matrix's.

    Raises:
        FrameError: a lens model other than OpenCV's with k1 k2 p1 p2 k3, or values no camera has.
    """
    K = [float(v) for v in (info.K if hasattr(info, "K") else info.k)]
    P = [float(v) for v in (info.P if hasattr(info, "P") else info.p)]
    D = [float(v) for v in (info.D if hasattr(info, "D") else info.d)]
    model = str(info.distortion_model)
    rectified = "rect" in topic
    if rectified:
        K, D = [P[0], P[1], P[2], P[4], P[5], P[6]], []
    if any(D) and model not in _PLAIN_MODELS:
        raise FrameError(f"lens model {model!r} is not k1 k2 p1 p2 k3")
    if any(D[5:]):
        raise FrameError(f"lens model {model!r} with {len(D)} coefficients is not k1 k2 p1 p2 k3")
    k1, k2, p1, p2, k3 = [*D[:5], *[0.0] * (5 - len(D[:5]))]
    try:
        return Intrinsics(
            width=int(info.width), height=int(info.height), fx=K[0], fy=K[4], cx=K[2], cy=K[5],
            k1=k1, k2=k2, p1=p1, p2=p2, k3=k3, depth_scale=depth_scale,
        )  # fmt: skip
    except ValueError:
        raise FrameError(f"no camera has fx {K[0]:g}, fy {K[4]:g} at {info.width}x{info.height}") from None


def _pixels(message: RosMessage, dtype: np.dtype[Any], channels: int, size: tuple[int, int], what: str) -> NDArray[Any]:
    """Return (H, W) or (H, W, channels) of a raw image, its row padding left out."""
    width, height = size
    if (int(message.width), int(message.height)) != size:
        raise FrameError(f"{what} image is {message.width}x{message.height}, expected {width}x{height}")
    step, used = int(message.step), width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if step < used or data.size < step * height:
        raise FrameError(f"{what} image has {data.size} bytes in rows of {step}, {height} rows of {used} expected")
    rows = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :used])
    pixels = rows.view(dtype.newbyteorder(">" if message.is_bigendian else "<"))
    return pixels.reshape(height, width, channels) if channels > 1 else pixels.reshape(height, width)


def _compressed_depth(message: RosMessage, width: int, height: int) -> tuple[NDArray[np.uint16], float]:
    form, data = str(message.format), bytes(message.data)
    if "compressedDepth" not in form:
        return decode_depth_image(data, width, height), MILLIMETRES
    if "rvl" in form.lower():
        raise FrameError("depth is compressed as RVL, expected PNG; set the publisher's format to png")
    if len(data) < _DEPTH_HEADER.size:
        raise FrameError(f"compressed depth has {len(data)} bytes")
    _, a, b = _DEPTH_HEADER.unpack_from(data)
    quantised = decode_depth_image(data[_DEPTH_HEADER.size :], width, height)
    if not form.startswith("32FC1"):
        return quantised, MILLIMETRES
    # compressed_depth_image_transport keeps a / z + b of each pixel, zero for none
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = np.where(quantised > 0, np.float32(a) / (quantised.astype(np.float32) - np.float32(b)), 0.0)
    return _from_metres(depth_m), _FLOAT_SCALE


def _from_metres(depth_m: NDArray[Any]) -> NDArray[np.uint16]:
    units = depth_m.astype(np.float64) * _FLOAT_SCALE
    good = np.isfinite(units) & (units > 0.0) & (units < np.iinfo(np.uint16).max)
    return np.rint(np.where(good, units, 0.0)).astype(np.uint16)
