"""PLY files: the vertices, and from where they were seen where treedock itself wrote that."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.common.geometry import rotation_from_quaternion
from services.detector.model import Floats, Views
from services.detector.readers_rows import MAX_HEADER, binary_table, check_count, coordinates, text_rows

_PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


_VIEWPOINT = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False

    def kind(self, form: str) -> np.dtype[Any]:
        """Return one row as NumPy sees it."""
        order = ">" if form == "binary_big_endian" else "<"
        return np.dtype([(name, order + kind) for name, kind in self.fields])


def read_ply(path: Path) -> tuple[Floats, Views | None]:
    """Return the vertices (N, 3), and their views where the file tells them.

    Raises:
        InputError: not a PLY, cut short, or without plain coordinates.
    """
    data = path.read_bytes()
    end = data.find(b"end_header", 0, MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"{path}: not a PLY file: its header has no beginning or no end")
    offset = data.find(b"\n", end) + 1
    if offset == 0:
        raise InputError(f"{path}: cut short in its header")
    form, elements = _ply_header(path, data[:end].decode("ascii", "replace"))
    before = 0
    for number, element in enumerate(elements):
        if element.name == "vertex":
            return _ply_vertices(path, data, offset, before, form, elements[number:])
        if element.has_list:
            raise InputError(f"{path}: element {element.name!r} with lists stands before the vertices")
        offset += element.count * element.kind(form).itemsize
        before += element.count
    raise InputError(f"{path}: a PLY without vertices")


def _ply_header(path: Path, header: str) -> tuple[str, list[_Element]]:
    form, elements = "", []
    for line in header.splitlines():
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == "format":
                form = words[1]
            elif words[0] == "element":
                elements.append(_Element(words[1], int(words[2])))
            elif words[0] == "property" and words[1] == "list":
                elements[-1].has_list = True
            elif words[0] == "property":
                elements[-1].fields.append((words[2], _PLY_KINDS[words[1]]))
        except (IndexError, ValueError, KeyError) as error:
            raise InputError(f"{path}: header line {line.strip()!r} is no PLY") from error
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise InputError(f"{path}: PLY format {form!r} is unknown")
    return form, elements


def _ply_vertices(
    path: Path, data: bytes, offset: int, before: int, form: str, elements: list[_Element]
) -> tuple[Floats, Views | None]:
    """Return the vertices, the first of ``elements``, and what a viewpoint element right behind them tells."""
    element = elements[0]
    names = [name for name, _ in element.fields]
    if element.has_list or not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        raise InputError(
            f"{path}: the vertices need plain properties x, y and z, they have {', '.join(names) or 'none'}"
        )
    check_count(path, element.count)
    if form == "ascii":
        columns = tuple(names.index(axis) for axis in "xyz")
        return text_rows(path, data[offset:], before, element.count, columns), None
    table = binary_table(path, data, offset, element.kind(form), element.count)
    points = coordinates(table)
    told = len(elements) > 1 and elements[1].name == "viewpoint" and "viewpoint" in names and not elements[1].has_list
    if not told or not set(_VIEWPOINT) <= {name for name, _ in elements[1].fields}:
        return points, None
    check_count(path, elements[1].count)
    behind = offset + element.count * table.dtype.itemsize
    return points, _views(
        points, table["viewpoint"], binary_table(path, data, behind, elements[1].kind(form), elements[1].count)
    )


def _views(points_m: Floats, index: NDArray[Any], cameras: NDArray[Any]) -> Views | None:
    """Return the views; None where the numbers make no sense (another program changed the file)."""
    origins = coordinates(cameras)
    turns = np.stack([cameras[name].astype(np.float64) for name in _VIEWPOINT[3:]], axis=1)
    lengths = np.linalg.norm(turns, axis=1)
    if len(index) == 0 or int(index.max()) >= len(cameras) or not np.isfinite(origins).all():
        return None
    if not (np.abs(lengths - 1.0) < 1e-3).all():
        return None
    rotations = np.stack([rotation_from_quaternion(q) for q in turns])
    rows = index.astype(np.int32)
    some = np.arange(0, len(points_m), max(1, len(points_m) // 20_000))
    local = np.einsum("nji,nj->ni", rotations[rows[some]], points_m[some] - origins[rows[some]])
    ahead = local[local[:, 2] > 0.5]
    tan_half = None
    if len(ahead) >= 100:
        across, up = np.percentile(np.abs(ahead[:, :2] / ahead[:, 2:]), 99.5, axis=0)
        tan_half = (float(across), float(up))
    return Views(rows, origins, rotations, tan_half)
