"""Pictures of a board from files, folders or a live source."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from schemas.camera import RgbdFrame
from services.camera.calibration.board import Board, Grey
from services.camera.calibration.coverage import Collector
from services.camera.calibration.judge import Limits, Picture, look
from services.camera.codecs import FrameError, check_container, decode_colour
from services.camera.sources.base import BadFrame
from services.common.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_CHECKED = (".png", ".jpg", ".jpeg")

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Gathered:
    """Pictures of one size."""

    pictures: tuple[Picture, ...]
    size_px: tuple[int, int]


def image_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and the pictures of the folders in order of their names.

    Raises:
        InputError: a path that is not there, or no picture at all.
    """
    files: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
        inside = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
        files += inside
    if not files:
        raise InputError(f"{', '.join(map(str, paths)) or 'calibrate'}: no pictures ({' '.join(SUFFIXES)}) were named")
    return files


def from_files(files: Sequence[Path], board: Board, limits: Limits, tell: Tell) -> Gathered:
    """Look for the board in each file; one of another size than the first, or a damaged one, is a fault.

    Raises:
        InputError: not one file is a picture.
    """
    size: tuple[int, int] | None = None
    pictures = []
    for number, path in enumerate(files, start=1):
        try:
            grey = read_grey(path)
        except FrameError as error:
            picture = Picture(path.name, f"unreadable: {error}")
        else:
            found = (grey.shape[1], grey.shape[0])
            size = size or found
            wrong = f"another size: {found[0]}x{found[1]}, the first is {size[0]}x{size[1]}" if found != size else ""
            picture = Picture(path.name, wrong) if wrong else look(path.name, grey, board, limits)
        pictures.append(picture)
        tell(f"{number}/{len(files)} {picture.name}: {picture.fault or 'board found'}")
    if size is None:
        raise InputError(f"{files[0]}: {pictures[0].fault}; none of {len(files)} files is a picture")
    return Gathered(tuple(pictures), size)


def read_grey(path: Path) -> Grey:
    """Return a picture file as (H, W) uint8.

    Raises:
        FrameError: it is damaged or no picture.
    """
    import cv2

    try:
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(f"{error.strerror}") from None
    if path.suffix.lower() in _CHECKED:
        check_container(data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    if image is None:
        raise FrameError("it is no picture that can be decoded")
    return np.asarray(image, dtype=np.uint8)


def from_live(items: Iterable[RgbdFrame | BadFrame], board: Board, limits: Limits, most: int, tell: Tell) -> Gathered:
    """Take pictures until they suffice, telling what is still missing; Ctrl-C ends it earlier.

    Raises:
        InputError: the source gave no picture.
    """
    collector: Collector | None = None
    pictures: list[Picture] = []
    faults: dict[str, int] = {}
    said = ""
    size = (0, 0)
    for name, grey in _greys(items):
        if collector is None:
            size = (grey.shape[1], grey.shape[0])
            collector = Collector(board, size, limits.needs, most)
        picture = look(name, grey, board, limits, thorough=False)
        if picture.sighting is None:
            faults[picture.fault.split(":")[0]] = faults.get(picture.fault.split(":")[0], 0) + 1
            now = f"{picture.fault}"
        elif collector.offer(picture.sighting):
            pictures.append(picture)
            now = f"picture {len(pictures)} taken; " + next(iter(collector.hints()), "that is enough")
        else:
            now = next(iter(collector.hints()), "")
        if now and now != said:
            said = now
            tell(now)
        if collector.done:
            break
    if collector is None:
        raise InputError("the source gave no picture")
    if not pictures:  # so that the verdict can say what was wrong with them
        pictures = [Picture("live", kind) for kind, count in faults.items() for _ in range(count)]
    return Gathered(tuple(pictures), size)


def _greys(items: Iterable[RgbdFrame | BadFrame]) -> Iterator[tuple[str, Grey]]:
    import cv2

    try:
        for item in items:
            if isinstance(item, RgbdFrame) and item.colour_encoding != "none":
                grey = cv2.cvtColor(decode_colour(item), cv2.COLOR_BGR2GRAY)
                yield f"frame {item.seq}", np.asarray(grey, dtype=np.uint8)
    except KeyboardInterrupt:
        return
