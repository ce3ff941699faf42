"""Tables of points in a file's bytes, binary or text; a table cut short is told in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError

Floats = NDArray[np.float64]

MAX_POINTS = 500_000_000
MAX_HEADER = 65_536


def check_count(path: Path, count: int) -> None:
    """Refuse a number of points that no file holds."""
    if not 0 <= count <= MAX_POINTS:
        raise InputError(f"{path}: its header announces {count} points, 0 to {MAX_POINTS} are possible")


def binary_table(path: Path, data: bytes, offset: int, kind: np.dtype[Any], count: int) -> NDArray[Any]:
    """Return ``count`` rows of a kind from an offset on."""
    held = (len(data) - offset) // kind.itemsize
    if held < count:
        raise InputError(f"{path}: cut short: {max(held, 0)} points of the {count} its header announces")
    return np.frombuffer(data, dtype=kind, count=count, offset=offset)


def coordinates(table: NDArray[Any]) -> Floats:
    """Return (N, 3) of a table's columns x, y, z."""
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)


def text_rows(path: Path, data: bytes, before: int, count: int, columns: tuple[int, ...]) -> Floats:
    """Return those columns of ``count`` lines after the first ``before``."""
    if count == 0:
        return np.zeros((0, 3))
    lines = data.decode("ascii", "replace").splitlines()[before : before + count]
    lines = [line for line in lines if line.strip()]
    if len(lines) < count:
        raise InputError(f"{path}: cut short: {len(lines)} points of the {count} its header announces")
    try:
        return np.loadtxt(lines, usecols=columns, ndmin=2, comments=None)
    except (ValueError, IndexError) as error:
        text = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: a point line is broken or cut: {text}") from error
