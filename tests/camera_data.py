"""Small made-up recordings for the tests of camera and process."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics, RgbdFrame
from services.camera.codecs import encode_colour, encode_depth

CAMERA = {"width": 48, "height": 32, "fx": 40.0, "fy": 40.0, "cx": 23.5, "cy": 15.5, "depth_scale": 5000.0}
INTRINSICS = Intrinsics.model_validate(CAMERA)
START_S = 1305031102
PERIOD_NS = 66_666_000


def colour_image(seed: int) -> NDArray[np.uint8]:
    """Return a smooth (32, 48, 3) picture: JPEG keeps it well."""
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 255, (4, 6, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(small, (48, 32), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def depth_image(seed: int) -> NDArray[np.uint16]:
    """Return (32, 48) raw depth, 0.2 to 8 m at 5000 a metre, with holes."""
    rng = np.random.default_rng(seed)
    depth = rng.integers(1_000, 40_000, (32, 48), dtype=np.uint16)
    depth[rng.random((32, 48)) < 0.1] = 0
    return depth


def frame(seq: int = 0, stamp_ns: int = 10**9) -> RgbdFrame:
    """Return a raw frame."""
    return RgbdFrame(
        stamp_ns=stamp_ns, seq=seq, intrinsics=INTRINSICS, colour=encode_colour(colour_image(seq), "bgr8"),
        depth=encode_depth(depth_image(seq), "z16"),
    )  # fmt: skip


def stamp_ns(index: int) -> int:
    """Return the colour stamp of the index-th frame of ``write_tum``."""
    return START_S * 10**9 + index * PERIOD_NS


def text(stamp: int) -> str:
    """Return a stamp as TUM files have it."""
    return f"{stamp // 10**9}.{stamp % 10**9 // 1000:06d}"


def write_tum(folder: Path, frames: int = 4, *, associations: bool = False, accelerometer: bool = False) -> Path:
    """Write a TUM RGB-D folder; the depth stamps are 7 ms behind the colour stamps."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    (folder / "camera.json").write_text(json.dumps(CAMERA))
    rows = []
    for index in range(frames):
        colour_stamp, depth_stamp = text(stamp_ns(index)), text(stamp_ns(index) + 7_000_000)
        rows.append((colour_stamp, f"rgb/{colour_stamp}.jpg", depth_stamp, f"depth/{depth_stamp}.png"))
        (folder / rows[-1][1]).write_bytes(encode_colour(colour_image(index), "jpeg", 95))
        (folder / rows[-1][3]).write_bytes(encode_depth(depth_image(index), "png"))
    (folder / "rgb.txt").write_text("# colour\n" + "".join(f"{r[0]} {r[1]}\n" for r in rows))
    (folder / "depth.txt").write_text("# depth\n" + "".join(f"{r[2]} {r[3]}\n" for r in rows))
    if associations:
        (folder / "associations.txt").write_text("".join(" ".join(r) + "\n" for r in rows))
    if accelerometer:
        stamps = range(stamp_ns(0) - 100_000_000, stamp_ns(frames), 2_000_000)
        (folder / "accelerometer.txt").write_text("".join(f"{text(s)} 0.1 9.8 -0.5\n" for s in stamps))
    return folder
