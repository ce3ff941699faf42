"""The camera's messages: intrinsics and the RGB-D frame with its small fixed binary header."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from pydantic import Field

from schemas.envelope import DecodeError, Part

ColourEncoding = Literal["bgr8", "jpeg", "none"]
DepthEncoding = Literal["z16", "png", "zstd"]

COLOUR_ENCODINGS: tuple[ColourEncoding, ...] = ("bgr8", "jpeg", "none")
DEPTH_ENCODINGS: tuple[DepthEncoding, ...] = ("z16", "png", "zstd")
MAX_SIDE_PX = 4096
_MAX_FOCAL_PX = 1e6
_MAX_DISTORTION = 1e4
MIN_DEPTH_SCALE, MAX_DEPTH_SCALE = 0.1, 1e6
"""Units per metre: from 10 m to a micrometre a unit."""
MAX_ACCEL_MPS2 = 1e5
DEPTH_AFTER_STEP_NS = 500_000
_MAX_STEPS = 127
"""One signed byte of the header; zero in frames from before there was a stamp of depth's own."""


def depth_after(colour_ns: int, depth_ns: int) -> int:
    """Return how long after the colour image the depth image was taken, as a frame carries it.

    Rounded to ``DEPTH_AFTER_STEP_NS``; what is further apart than 63.5 ms comes out as that.
    """
    return DEPTH_AFTER_STEP_NS * _steps(depth_ns - colour_ns)


def _steps(after_ns: int) -> int:
    return min(max(round(after_ns / DEPTH_AFTER_STEP_NS), -_MAX_STEPS), _MAX_STEPS)


class Intrinsics(Part):
    """Pinhole camera with the OpenCV distortion model; depth is registered to this (colour) camera.

    ``depth_scale`` is in units per metre: ``depth_m = depth_raw / depth_scale``, zero is no data.
    """

    width: int = Field(gt=0, le=MAX_SIDE_PX)
    height: int = Field(gt=0, le=MAX_SIDE_PX)
    fx: float = Field(ge=1.0, le=_MAX_FOCAL_PX)
    fy: float = Field(ge=1.0, le=_MAX_FOCAL_PX)
    cx: float = Field(ge=-_MAX_FOCAL_PX, le=_MAX_FOCAL_PX)
    cy: float = Field(ge=-_MAX_FOCAL_PX, le=_MAX_FOCAL_PX)
    k1: float = Field(default=0.0, ge=-_MAX_DISTORTION, le=_MAX_DISTORTION)
    k2: float = Field(default=0.0, ge=-_MAX_DISTORTION, le=_MAX_DISTORTION)
    p1: float = Field(default=0.0, ge=-_MAX_DISTORTION, le=_MAX_DISTORTION)
    p2: float = Field(default=0.0, ge=-_MAX_DISTORTION, le=_MAX_DISTORTION)
    k3: float = Field(default=0.0, ge=-_MAX_DISTORTION, le=_MAX_DISTORTION)
    depth_scale: float = Field(default=1000.0, ge=MIN_DEPTH_SCALE, le=MAX_DEPTH_SCALE)

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient is other than zero."""
        return any((self.k1, self.k2, self.p1, self.p2, self.k3))


@dataclass(frozen=True)
class RgbdFrame:
    """One colour image with the depth image registered to it.

    Bytes layout: the header of ``_HEADER`` (little endian), then the colour bytes, then the depth bytes.
    """

    SCHEMA: ClassVar[str] = "treedock.rgbd"
    VERSION: ClassVar[int] = 1
    MAX_BYTES: ClassVar[int] = 16 * 1024 * 1024

    stamp_ns: int
    seq: int
    intrinsics: Intrinsics
    colour: bytes | bytearray | memoryview = field(repr=False)
    depth: bytes | bytearray | memoryview = field(repr=False)
    colour_encoding: ColourEncoding = "bgr8"
    depth_encoding: DepthEncoding = "z16"
    render_scale: float = 1.0
    """Below 1: rendered at that share of the size and scaled up (the simulator's reduced mode)."""
    accel_camera: tuple[float, float, float] | None = None
    """Mean specific force since the last frame, m/s^2, camera frame; at rest it points up."""
    depth_after_ns: int = 0
    """The depth image's stamp less the colour image's, which is the frame's: a whole number of ``DEPTH_AFTER_STEP_NS``, see
    ``depth_after``."""

    @classmethod
    def encoding(cls) -> str:
        """Return the Zenoh encoding string."""
        return f"application/vnd.treedock.rgbd;v={cls.VERSION}"

    def header_bytes(self) -> bytes:
        """Return the fixed header alone."""
        i = self.intrinsics
        accel = self.accel_camera if self.accel_camera is not None else (math.nan,) * 3
        return _HEADER.pack(
            _MAGIC, self.VERSION, COLOUR_ENCODINGS.index(self.colour_encoding),
            DEPTH_ENCODINGS.index(self.depth_encoding), _steps(self.depth_after_ns), self.stamp_ns, self.seq,
            i.width, i.height, i.fx, i.fy, i.cx, i.cy, i.k1, i.k2, i.p1, i.p2, i.k3, i.depth_scale,
            self.render_scale, *accel, len(self.colour), len(self.depth),
        )  # fmt: skip

    def to_bytes(self) -> bytearray:
        """Return the message as one bytearray (Zenoh shares those of 3 KB and more by itself)."""
        out = bytearray(_HEADER.size + len(self.colour) + len(self.depth))
        out[: _HEADER.size] = self.header_bytes()
        split = _HEADER.size + len(self.colour)
        out[_HEADER.size : split] = self.colour
        out[split:] = self.depth
        return out

    @classmethod
    def from_bytes(cls, data: bytes | bytearray | memoryview) -> RgbdFrame:
        """Parse a message; colour and depth are views into ``data``.

        Raises:
            DecodeError: for anything but a whole, sane frame of this version.
        """
        view = memoryview(data)
        if len(view) < _HEADER.size:
            raise DecodeError(f"rgbd frame of {len(view)} bytes is shorter than its {_HEADER.size} byte header")
        if len(view) > cls.MAX_BYTES:
            raise DecodeError(f"rgbd frame of {len(view)} bytes is larger than {cls.MAX_BYTES}")
        values = _HEADER.unpack(view[: _HEADER.size])
        magic, version, colour_code, depth_code, after = values[:5]
        if magic != _MAGIC:
            raise DecodeError("not an rgbd frame: the first four bytes are not TDRF")
        if version != cls.VERSION:
            raise DecodeError(f"rgbd frame of version {version}, this is version {cls.VERSION}")
        if colour_code >= len(COLOUR_ENCODINGS) or depth_code >= len(DEPTH_ENCODINGS):
            raise DecodeError(f"rgbd frame with unknown colour ({colour_code}) or depth ({depth_code}) encoding")
        colour_len, depth_len = values[-2:]
        if len(view) != _HEADER.size + colour_len + depth_len:
            raise DecodeError(
                f"rgbd frame has {len(view)} bytes, its header says {_HEADER.size + colour_len + depth_len}"
            )
        accel = values[20:23]
        split = _HEADER.size + colour_len
        frame = cls(
            stamp_ns=values[5], seq=values[6], intrinsics=_intrinsics(values[7:19]),
            colour=view[_HEADER.size : split], depth=view[split:],
            colour_encoding=COLOUR_ENCODINGS[colour_code], depth_encoding=DEPTH_ENCODINGS[depth_code],
            render_scale=values[19], accel_camera=None if math.isnan(accel[0]) else (accel[0], accel[1], accel[2]),
            depth_after_ns=after * DEPTH_AFTER_STEP_NS,
        )  # fmt: skip
        _check(frame)
        return frame


_MAGIC = b"TDRF"
_HEADER = struct.Struct("<4sBBBbqQII10dd3dII")


def _intrinsics(values: tuple[float, ...]) -> Intrinsics:
    names = ("width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "depth_scale")
    try:
        return Intrinsics.model_validate(dict(zip(names, values, strict=True)))
    except ValueError as error:
        raise DecodeError(f"rgbd frame with impossible intrinsics: {values}") from error


def _check(frame: RgbdFrame) -> None:
    size = frame.intrinsics.width * frame.intrinsics.height
    if frame.colour_encoding == "bgr8" and len(frame.colour) != 3 * size:
        raise DecodeError(f"rgbd frame with {len(frame.colour)} colour bytes, {3 * size} expected")
    if frame.depth_encoding == "z16" and len(frame.depth) != 2 * size:
        raise DecodeError(f"rgbd frame with {len(frame.depth)} depth bytes, {2 * size} expected")
    if frame.stamp_ns < 0:
        raise DecodeError(f"rgbd frame with the negative stamp {frame.stamp_ns}")
    if not 0.0 < frame.render_scale <= 1.0:
        raise DecodeError(f"rgbd frame with render scale {frame.render_scale}, expected above 0 and at most 1")
    if frame.accel_camera is not None and not all(abs(a) <= MAX_ACCEL_MPS2 for a in frame.accel_camera):
        raise DecodeError(f"rgbd frame with acceleration {frame.accel_camera}")
