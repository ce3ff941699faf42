"""Depth as it travels, to arrays: PNG of 16 bits, zstd or plain.

Apart from ``codecs.py``, whose JPEG check is a compiled kernel: a service that looks at depth alone needs none, and its
unit may forbid code that is made at run time.
"""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from schemas.camera import DepthEncoding

if TYPE_CHECKING:
    from collections.abc import Iterator

Bytes = bytes | bytearray | memoryview

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8\xff"


class FrameError(ValueError):
    """An image that cannot be used; the text is one line that says what is wrong with it."""


def check_png(view: memoryview) -> None:
    """Check that a PNG is whole, by its chunks and checksums.

    Raises:
        FrameError: no PNG, cut short, or damaged inside.
    """
    if len(view) == 0:
        raise FrameError("the image is empty (0 bytes)")
    if view[:8] != PNG_MAGIC:
        raise FrameError(f"neither PNG nor JPEG: it begins with {bytes(view[:4]).hex()}")
    if not any(kind == b"IEND" for kind in _png_chunks(view)):
        raise FrameError(f"truncated PNG: no IEND chunk in {len(view)} bytes")


def _png_chunks(view: memoryview) -> Iterator[bytes]:
    cursor = len(PNG_MAGIC)
    while cursor + 12 <= len(view):
        (length,) = struct.unpack(">I", view[cursor : cursor + 4])
        end = cursor + 12 + length
        if end > len(view):
            raise FrameError(f"truncated PNG: a chunk of {length} bytes ends beyond the file's {len(view)} bytes")
        (crc,) = struct.unpack(">I", view[end - 4 : end])
        if zlib.crc32(view[cursor + 4 : end - 4]) != crc:
            raise FrameError("damaged PNG: a chunk fails its checksum")
        yield bytes(view[cursor + 4 : cursor + 8])
        cursor = end


def decode_image(data: Bytes, flag_name: str) -> NDArray[np.generic]:
    """Return an image whose container was checked, by OpenCV's flag of that name.

    Raises:
        FrameError: OpenCV refuses it.
    """
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), getattr(cv2, flag_name))
    except cv2.error as error:
        raise FrameError(f"the image cannot be decoded: {error.err or 'OpenCV refused it'}") from None
    if image is None:
        raise FrameError("the image cannot be decoded: its data is damaged")
    return np.asarray(image)


def decode_depth_image(data: Bytes, width: int, height: int) -> NDArray[np.uint16]:
    """Return the 16 bit PNG as (height, width) uint16, raw units.

    Raises:
        FrameError: damaged, of another size, or not one 16 bit channel.
    """
    view = memoryview(data)
    if view[:3] == JPEG_START:
        raise FrameError(
            "depth image is a JPEG, expected a 16 bit PNG: is it the colour image (colour and depth swapped)?"
        )
    check_png(view)
    image = decode_image(data, "IMREAD_UNCHANGED")
    if image.shape[:2] != (height, width):
        raise FrameError(f"depth image is {image.shape[1]}x{image.shape[0]}, expected {width}x{height}")
    if image.ndim != 2 or image.dtype != np.uint16:
        channels = 1 if image.ndim == 2 else image.shape[2]
        swapped = ": is it the colour image (colour and depth swapped)?" if channels >= 3 else ""
        raise FrameError(f"depth image has {channels} channel(s) of {image.dtype}, expected one of uint16{swapped}")
    return image.astype(np.uint16, copy=False)


def decode_depth(data: Bytes, encoding: DepthEncoding, width: int, height: int) -> NDArray[np.uint16]:
    """Return depth bytes in any wire encoding as (height, width) uint16 raw units; ``z16`` is a view.

    Raises:
        FrameError: the bytes are not such an image.
    """
    if encoding == "png":
        return decode_depth_image(data, width, height)
    raw = _unzstd(data, 2 * width * height) if encoding == "zstd" else data
    if len(raw) != 2 * width * height:
        raise FrameError(f"depth has {len(raw)} bytes, {2 * width * height} expected for {width}x{height}")
    return np.frombuffer(raw, "<u2").reshape(height, width)


def _unzstd(data: Bytes, size: int) -> bytes:
    import zstandard

    try:
        return zstandard.ZstdDecompressor().decompress(bytes(data), max_output_size=size)
    except zstandard.ZstdError as error:
        raise FrameError(f"depth is not {size} bytes of zstd: {str(error)[:120]}") from None
