"""Point clouds from files: ply, pcd, las, laz, xyz. A file that cannot be used gives one line that says why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.detector.model import Views
from services.detector.readers_las import read_las
from services.detector.readers_pcd import read_pcd
from services.detector.readers_ply import read_ply

Floats = NDArray[np.float64]

_MAX_REFUSED_SHARE = 0.5
_TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts")


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of a file, (N, 3) metres in the file's frame, finite; and how many were refused as not finite."""

    points_m: Floats = field(repr=False)
    refused: int
    views: Views | None = None
    """From where the points were seen, where the file tells (treedock's own cloud.ply)."""


def read_cloud(path: Path) -> Cloud:
    """Read a cloud; the kind is told by the file's suffix.

    Raises:
        InputError: no such file, unknown kind, cut short, empty, or most of its points are NaN or infinite.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: no such file" if not path.exists() else f"{path}: not a file, a point cloud was expected"
        )
    kind = path.suffix.lower()
    readers: dict[str, Callable[[Path], Floats]] = {".pcd": read_pcd, ".las": read_las, ".laz": read_las}
    readers.update(dict.fromkeys(_TEXT_SUFFIXES, _read_xyz))
    if kind not in readers and kind != ".ply":
        raise InputError(f"{path}: unknown kind {kind or 'without suffix'!r}; ply, pcd, las, laz and xyz are read")
    try:
        points, views = read_ply(path) if kind == ".ply" else (readers[kind](path), None)
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if len(points) == 0:
        raise InputError(f"{path}: holds no points")
    with np.errstate(invalid="ignore"):
        good = (np.abs(points) < 1e9).all(axis=1)
    refused = int(len(points) - np.count_nonzero(good))
    if refused > _MAX_REFUSED_SHARE * len(points):
        raise InputError(f"{path}: {refused} of {len(points)} points are NaN, infinite or beyond 1e9 m")
    if views is not None and refused:
        views = replace(views, index=views.index[good])
    return Cloud(np.ascontiguousarray(points[good] if refused else points, dtype=np.float64), refused, views)


def _read_xyz(path: Path) -> Floats:
    with path.open("rb") as stream:
        head = stream.read(4096)
    if b"\0" in head:
        raise InputError(f"{path}: binary data, text with x y z per line was expected")
    lines = head.decode("utf-8", "replace").splitlines()
    skip = 0
    while skip < len(lines) and not _numbers(lines[skip]):
        skip += 1
    if skip >= len(lines) or skip > 20:
        raise InputError(f"{path}: no line with three numbers x y z near the beginning")
    delimiter = next((d for d in (",", ";") if d in lines[skip]), None)
    try:
        return np.loadtxt(path, usecols=(0, 1, 2), skiprows=skip, delimiter=delimiter, comments=("#", "//"), ndmin=2)
    except (ValueError, IndexError) as error:
        text = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: not x y z per line: {text}") from error


def _numbers(line: str) -> bool:
    parts = line.replace(",", " ").replace(";", " ").split()
    try:
        return len([float(p) for p in parts[:3]]) == 3
    except ValueError:
        return False
