"""Image bytes to arrays and back. A damaged image gives one FrameError, never a half-grey picture.

OpenCV fills what is missing of a cut JPEG or PNG with grey and prints to stderr; so the container is checked first:
a PNG by its chunks and checksums, a JPEG by walking its data (``jpeg.py``).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from schemas.camera import ColourEncoding, DepthEncoding, RgbdFrame
from services.camera.depth_codec import (
    JPEG_START,
    PNG_MAGIC,
    Bytes,
    check_png,
    decode_image,
)
from services.camera.depth_codec import FrameError as FrameError
from services.camera.depth_codec import decode_depth as decode_depth
from services.camera.depth_codec import decode_depth_image as decode_depth_image
from services.camera.jpeg import jpeg_fault

_JPEG_END = b"\xff\xd9"
_PNG_LEVEL = 1
"""zlib level of our depth images: level 1 costs a third of the default's time for a tenth more bytes."""
_ZSTD_LEVEL = 1


def check_container(data: Bytes) -> None:
    """Check that a PNG or JPEG is whole.

    Raises:
        FrameError: neither PNG nor JPEG, cut short, or damaged inside.
    """
    view = memoryview(data)
    if view[:3] == JPEG_START:
        if not bytes(view[-64:]).rstrip(b"\0").endswith(_JPEG_END):
            raise FrameError(f"truncated JPEG: no end marker in {len(view)} bytes")
        if fault := jpeg_fault(view):
            raise FrameError(fault)
        return
    check_png(view)


def decode_colour_image(data: Bytes, width: int, height: int) -> NDArray[np.uint8]:
    """Return the PNG or JPEG as (height, width, 3) uint8 BGR.

    Raises:
        FrameError: damaged, or of another size.
    """
    if memoryview(data)[:8] == PNG_MAGIC and _png_bits(data) == 16:
        raise FrameError(
            "colour image has 16 bits a pixel, expected 8: is it the depth image (colour and depth swapped)?"
        )
    check_container(data)
    image = decode_image(data, "IMREAD_COLOR")
    if image.shape != (height, width, 3) or image.dtype != np.uint8:
        raise FrameError(f"colour image is {image.shape[1]}x{image.shape[0]}, expected {width}x{height}")
    return image.astype(np.uint8, copy=False)


def _png_bits(data: Bytes) -> int:
    """Return the bits a sample of a PNG has (its IHDR chunk comes first), 0 when it is cut before that."""
    return data[24] if len(data) > 24 else 0


def decode_depth_raw(frame: RgbdFrame) -> NDArray[np.uint16]:
    """Return the frame's depth as (H, W) uint16 in its own units.

    Raises:
        FrameError: naming the frame.
    """
    i = frame.intrinsics
    try:
        return decode_depth(frame.depth, frame.depth_encoding, i.width, i.height)
    except FrameError as error:
        raise FrameError(f"frame {frame.seq} ({frame.stamp_ns}): {error}") from None


def decode_depth_m(frame: RgbdFrame) -> NDArray[np.float32]:
    """Return the frame's depth as (H, W) float32 metres, 0 is no data.

    Raises:
        FrameError: naming the frame.
    """
    return decode_depth_raw(frame).astype(np.float32) / np.float32(frame.intrinsics.depth_scale)


def decode_colour(frame: RgbdFrame) -> NDArray[np.uint8]:
    """Return the frame's colour as (H, W, 3) uint8 BGR; raw bytes give a read-only view.

    Raises:
        FrameError: naming the frame; also when the frame has no colour.
    """
    i = frame.intrinsics
    try:
        if frame.colour_encoding == "jpeg":
            return decode_colour_image(frame.colour, i.width, i.height)
        if frame.colour_encoding == "none":
            raise FrameError("it carries no colour")
        if len(frame.colour) != 3 * i.width * i.height:
            raise FrameError(f"colour has {len(frame.colour)} bytes, {3 * i.width * i.height} expected")
        return np.frombuffer(frame.colour, np.uint8).reshape(i.height, i.width, 3)
    except FrameError as error:
        raise FrameError(f"frame {frame.seq} ({frame.stamp_ns}): {error}") from None


def encode_depth(depth_raw: NDArray[np.uint16], encoding: DepthEncoding) -> bytes:
    """Return (H, W) uint16 raw units in a wire encoding; every encoding is lossless."""
    little = np.ascontiguousarray(depth_raw, dtype="<u2")
    if encoding == "z16":
        return little.tobytes()
    if encoding == "zstd":
        import zstandard

        return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(little.tobytes())
    import cv2

    return bytes(cv2.imencode(".png", depth_raw, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])[1])


def encode_colour(bgr: NDArray[np.uint8], encoding: ColourEncoding, jpeg_quality: int = 90) -> bytes:
    """Return (H, W, 3) uint8 BGR in a wire encoding (JPEG is lossy)."""
    if encoding == "none":
        return b""
    if encoding == "bgr8":
        return np.ascontiguousarray(bgr).tobytes()
    import cv2

    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1])


def recode(frame: RgbdFrame, colour: ColourEncoding, depth: DepthEncoding, jpeg_quality: int = 90) -> RgbdFrame:
    """Return the frame in other wire encodings; a part that has the wanted one already keeps its bytes.

    Raises:
        FrameError: the frame's own bytes cannot be decoded.
    """
    colour_bytes: Bytes = frame.colour
    if colour != frame.colour_encoding:
        colour_bytes = b"" if colour == "none" else encode_colour(decode_colour(frame), colour, jpeg_quality)
    depth_bytes: Bytes = frame.depth
    if depth != frame.depth_encoding:
        depth_bytes = encode_depth(decode_depth_raw(frame), depth)
    return dataclasses.replace(
        frame, colour=colour_bytes, depth=depth_bytes, colour_encoding=colour, depth_encoding=depth
    )


def raw(frame: RgbdFrame) -> RgbdFrame:
    """Return the frame uncompressed: ``bgr8`` (or ``none``) and ``z16``.

    Raises:
        FrameError: the frame's own bytes cannot be decoded.
    """
    return recode(frame, "none" if frame.colour_encoding == "none" else "bgr8", "z16")
