"""TUM RGB-D folders: rgb.txt, depth.txt, [associations.txt], [accelerometer.txt], camera.json.

groundtruth.txt is never opened: results do not depend on it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame, depth_after
from services.camera.codecs import FrameError, decode_colour_image, decode_depth_image, encode_colour, encode_depth
from services.camera.config import CameraConfig
from services.camera.sources.accelerometer import Accelerometer
from services.camera.sources.associate import associate, unpaired
from services.camera.sources.base import BadFrame
from services.camera.sources.camera_json import read_intrinsics
from services.camera.sources.registration import registration_for
from services.camera.sources.text import Row, read_rows, stamp_ns_of
from services.common.errors import InputError

T = TypeVar("T")

_FIRST_WINDOW_NS = 100_000_000
"""The first frame has no frame before it; its accelerometer mean is over this long."""


@dataclass(frozen=True, slots=True)
class Pair:
    """One frame's files; the stamp is the colour image's."""

    stamp_ns: int
    colour: Path
    depth: Path
    apart_ns: int = 0
    """The depth image's stamp less the colour image's."""


class TumSource:
    """Frames of one TUM RGB-D folder."""

    paced = True

    def __init__(self, folder: Path, config: CameraConfig) -> None:
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder")
        self.name = str(folder)
        self._pairs = _pairs(folder, config)
        self.expected: int | None = len(self._pairs)
        self.remark = _apart(self._pairs, round(config.associate_within_s * 1e9))
        self.intrinsics: Intrinsics = read_intrinsics(
            Path(config.camera_file) if config.camera_file else folder / "camera.json"
        )
        self._registration = registration_for(config, self.intrinsics)
        accelerometer = folder / "accelerometer.txt"
        self._accelerometer = Accelerometer.from_file(accelerometer) if accelerometer.exists() else None

    def __iter__(self) -> Iterator[RgbdFrame | BadFrame]:
        """Yield the frames in the order of their stamps."""
        before_ns = self._pairs[0].stamp_ns - _FIRST_WINDOW_NS
        for seq, pair in enumerate(self._pairs):
            try:
                yield self._load(pair, seq, before_ns)
            except FrameError as error:
                yield BadFrame(pair.stamp_ns, str(error))
            before_ns = pair.stamp_ns

    def _load(self, pair: Pair, seq: int, before_ns: int) -> RgbdFrame:
        camera, registration = self.intrinsics, self._registration
        colour = _decoded(pair.colour, decode_colour_image, camera)
        depth = _decoded(pair.depth, decode_depth_image, registration.camera if registration else camera)
        if registration is not None:
            depth = registration.apply(depth)
        accel = self._accelerometer.mean_between(before_ns, pair.stamp_ns) if self._accelerometer else None
        return RgbdFrame(
            stamp_ns=pair.stamp_ns, seq=seq, intrinsics=camera, colour=encode_colour(colour, "bgr8"),
            depth=encode_depth(depth, "z16"), accel_camera=accel,
            depth_after_ns=depth_after(pair.stamp_ns, pair.stamp_ns + pair.apart_ns),
        )  # fmt: skip


def _decoded(path: Path, decode: Callable[[bytes, int, int], T], camera: Intrinsics) -> T:
    try:
        return decode(path.read_bytes(), camera.width, camera.height)
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # a FrameError, or a name that no file can have
        raise FrameError(f"{str(path)!a}: {error}" if "\0" in str(path) else f"{path}: {error}") from None


def _pairs(folder: Path, config: CameraConfig) -> list[Pair]:
    """Return the frames of a folder in the order of their stamps.

    Raises:
        InputError: no list of images, a broken one, two frames of one stamp, or none at all.
    """
    listed = folder / "associations.txt"
    if listed.exists():
        rows = read_rows(listed, columns=4, what="'stamp colour stamp depth'")
        pairs = [_listed(row, folder, listed) for row in rows]
    else:
        pairs = _associated(folder, config)
    if not pairs:
        raise InputError(f"{listed}: no frames: it lists none")
    pairs.sort(key=lambda pair: pair.stamp_ns)
    for before, after in itertools.pairwise(pairs):
        if before.stamp_ns == after.stamp_ns:
            raise InputError(f"{folder}: two frames with the stamp {after.stamp_ns / 1e9:.6f}")
    return pairs


def _associated(folder: Path, config: CameraConfig) -> list[Pair]:
    lists = [folder / "rgb.txt", folder / "depth.txt"]
    for path in lists:
        if not path.exists():
            raise InputError(
                f"{path}: no such file; expected a TUM RGB-D folder (rgb.txt, depth.txt, camera.json) or an .mcap file"
            )
    colour, depth = (read_rows(path, columns=2, what="'stamp file'") for path in lists)
    colour_ns, depth_ns = (
        np.array([stamp_ns_of(row, 0, path) for row in rows], dtype=np.int64)
        for path, rows in zip(lists, (colour, depth), strict=True)
    )
    within_ns = round(config.associate_within_s * 1e9)
    matches = associate(colour_ns, depth_ns, within_ns)
    if not matches:
        raise InputError(f"{folder}: no frames: {unpaired(colour_ns, depth_ns, within_ns)}")
    return [
        Pair(
            int(colour_ns[i]), folder / colour[i].fields[1], folder / depth[k].fields[1], int(depth_ns[k] - colour_ns[i])
        )
        for i, k in matches
    ]  # fmt: skip


def _listed(row: Row, folder: Path, path: Path) -> Pair:
    """Return a line of associations.txt."""
    colour_ns, depth_ns = stamp_ns_of(row, 0, path), stamp_ns_of(row, 2, path)
    return Pair(colour_ns, folder / row.fields[1], folder / row.fields[3], depth_ns - colour_ns)


def _apart(pairs: list[Pair], within_ns: int) -> str:
    """Return a remark on pairs whose stamps are too far apart to show one moment: a list may pair what it likes."""
    apart_ns = int(np.median([pair.apart_ns for pair in pairs]))
    far = sum(abs(pair.apart_ns) > within_ns for pair in pairs)
    if not far:
        return ""
    return (
        f"{far} of {len(pairs)} frames pair colour with depth of another time: depth is usually {apart_ns / 1e6:+.0f} ms "
        f"off, at most {within_ns / 1e6:.0f} ms is one moment (camera.associate_within_s)"
    )
