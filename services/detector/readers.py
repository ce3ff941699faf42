"""Point clouds from files: ply, pcd, las, laz, xyz. A file that cannot be used gives one line that says why."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError

Floats = NDArray[np.float64]

_MAX_POINTS = 500_000_000
_MAX_REFUSED_SHARE = 0.5
_MAX_HEADER = 65_536
_TEXT_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", ".pts")


@dataclass(frozen=True, slots=True)
class Cloud:
    """Points of a file, (N, 3) metres in the file's frame, finite; and how many were refused as not finite."""

    points_m: Floats = field(repr=False)
    refused: int


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
    readers = {".ply": _read_ply, ".pcd": _read_pcd, ".las": _read_las, ".laz": _read_las}
    readers.update(dict.fromkeys(_TEXT_SUFFIXES, _read_xyz))
    if kind not in readers:
        raise InputError(f"{path}: unknown kind {kind or 'without suffix'!r}; ply, pcd, las, laz and xyz are read")
    try:
        points = readers[kind](path)
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if len(points) == 0:
        raise InputError(f"{path}: holds no points")
    with np.errstate(invalid="ignore"):
        good = (np.abs(points) < 1e9).all(axis=1)
    refused = int(len(points) - np.count_nonzero(good))
    if refused > _MAX_REFUSED_SHARE * len(points):
        raise InputError(f"{path}: {refused} of {len(points)} points are NaN, infinite or beyond 1e9 m")
    return Cloud(np.ascontiguousarray(points[good] if refused else points, dtype=np.float64), refused)


def _read_las(path: Path) -> Floats:
    import laspy

    try:
        las = laspy.read(path)
        expected = int(las.header.point_count)
        points = np.stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)], axis=1)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # laspy and its decompressor raise many kinds, also bare struct and Rust errors
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"{path}: not a whole LAS/LAZ file: {text}") from error
    if len(points) < expected:
        raise InputError(f"{path}: cut short: {len(points)} points of the {expected} its header announces")
    return points


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


# -- PLY

_PLY_KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    has_list: bool = False


def _read_ply(path: Path) -> Floats:
    data = path.read_bytes()
    end = data.find(b"end_header", 0, _MAX_HEADER)
    if not data.startswith(b"ply") or end < 0:
        raise InputError(f"{path}: not a PLY file: its header has no beginning or no end")
    body = data.find(b"\n", end) + 1
    if body == 0:
        raise InputError(f"{path}: cut short in its header")
    form, elements = _ply_header(path, data[:end].decode("ascii", "replace"))
    offset, before = body, 0
    for element in elements:
        if element.name == "vertex":
            return _ply_vertices(path, data, offset, before, form, element)
        if element.has_list:
            raise InputError(f"{path}: element {element.name!r} with lists stands before the vertices")
        order = ">" if form == "binary_big_endian" else "<"
        offset += element.count * np.dtype([(n, order + k) for n, k in element.fields]).itemsize
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


def _ply_vertices(path: Path, data: bytes, offset: int, before: int, form: str, element: _Element) -> Floats:
    names = [name for name, _ in element.fields]
    if element.has_list or not {"x", "y", "z"} <= set(names) or len(set(names)) != len(names):
        raise InputError(
            f"{path}: the vertices need plain properties x, y and z, they have {', '.join(names) or 'none'}"
        )
    _check_count(path, element.count)
    if form == "ascii":
        columns = tuple(names.index(axis) for axis in "xyz")
        return _text_rows(path, data[offset:], before, element.count, columns)
    order = ">" if form == "binary_big_endian" else "<"
    kind = np.dtype([(name, order + k) for name, k in element.fields])
    return _binary_rows(path, data, offset, kind, element.count)


def _check_count(path: Path, count: int) -> None:
    if not 0 <= count <= _MAX_POINTS:
        raise InputError(f"{path}: its header announces {count} points, 0 to {_MAX_POINTS} are possible")


def _binary_rows(path: Path, data: bytes, offset: int, kind: np.dtype[Any], count: int) -> Floats:
    held = (len(data) - offset) // kind.itemsize
    if held < count:
        raise InputError(f"{path}: cut short: {max(held, 0)} points of the {count} its header announces")
    table = np.frombuffer(data, dtype=kind, count=count, offset=offset)
    return np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _text_rows(path: Path, data: bytes, before: int, count: int, columns: tuple[int, ...]) -> Floats:
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


# -- PCD

_PCD_KINDS = {("F", 4): "f4", ("F", 8): "f8", ("I", 1): "i1", ("I", 2): "i2", ("I", 4): "i4", ("I", 8): "i8",
              ("U", 1): "u1", ("U", 2): "u2", ("U", 4): "u4", ("U", 8): "u8"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _PcdHeader:
    names: list[str]
    kinds: list[str]
    repeats: list[int]
    points: int
    form: str
    body: int


def _read_pcd(path: Path) -> Floats:
    data = path.read_bytes()
    header = _pcd_header(path, data)
    _check_count(path, header.points)
    if header.form == "ascii":
        starts = np.concatenate([[0], np.cumsum(header.repeats)])
        columns = tuple(int(starts[header.names.index(axis)]) for axis in "xyz")
        return _text_rows(path, data[header.body :], 0, header.points, columns)
    fields = [(n, "<" + k, (r,)) if r != 1 else (n, "<" + k) for n, k, r in zip(_unique(header.names), header.kinds, header.repeats, strict=True)]  # fmt: skip
    if header.form == "binary":
        return _binary_rows(path, data, header.body, np.dtype(fields), header.points)
    return _compressed_rows(path, data, header)


def _unique(names: list[str]) -> list[str]:
    """PCD pads with fields all named ``_``."""
    return [name if names.index(name) == i else f"{name}.{i}" for i, name in enumerate(names)]


def _pcd_header(path: Path, data: bytes) -> _PcdHeader:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = data.find(b"\n", at, _MAX_HEADER)
        if end < 0:
            raise InputError(f"{path}: not a PCD file, or cut short in its header: no DATA line")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    try:
        names, sizes, types = entries["FIELDS"], [int(s) for s in entries["SIZE"]], entries["TYPE"]
        repeats = [int(c) for c in entries.get("COUNT", ["1"] * len(names))]
        points = (
            int(entries["POINTS"][0]) if "POINTS" in entries else int(entries["WIDTH"][0]) * int(entries["HEIGHT"][0])
        )
        kinds = [_PCD_KINDS[t, s] for t, s in zip(types, sizes, strict=True)]
        form = entries["DATA"][0]
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{path}: a PCD header entry is missing or broken: {error}") from error
    if not {"x", "y", "z"} <= set(names) or not len(names) == len(kinds) == len(repeats):
        raise InputError(f"{path}: the fields need x, y and z with size and type, they are {' '.join(names)}")
    if form not in ("ascii", "binary", "binary_compressed"):
        raise InputError(f"{path}: PCD data kind {form!r} is unknown")
    return _PcdHeader(names, kinds, repeats, points, form, at)


def _compressed_rows(path: Path, data: bytes, header: _PcdHeader) -> Floats:
    """Read fields one after the other from an LZF block."""
    sizes = [np.dtype(k).itemsize * r for k, r in zip(header.kinds, header.repeats, strict=True)]
    if len(data) < header.body + 8:
        raise InputError(f"{path}: cut short before its compressed block")
    packed, unpacked = struct.unpack_from("<II", data, header.body)
    block = data[header.body + 8 : header.body + 8 + packed]
    if len(block) < packed:
        raise InputError(f"{path}: cut short: {len(block)} bytes of the {packed} its compressed block needs")
    if unpacked != header.points * sum(sizes):
        raise InputError(f"{path}: unpacks to {unpacked} bytes, {header.points * sum(sizes)} expected")
    raw = lzf_decompress(block, unpacked)
    if raw is None:
        raise InputError(f"{path}: its compressed block is damaged")
    columns = []
    for axis in "xyz":
        i = header.names.index(axis)
        offset = header.points * sum(sizes[:i])
        kind = np.dtype("<" + header.kinds[i])
        columns.append(np.frombuffer(raw, dtype=kind, count=header.points, offset=offset).astype(np.float64))
    return np.stack(columns, axis=1)


def lzf_decompress(packed: bytes, size: int) -> bytes | None:
    """Return ``size`` bytes from an LZF stream (Lehmann's format as PCD uses it), None when it is damaged."""
    out, at, end = bytearray(), 0, len(packed)
    while at < end:
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7 and at < end:
            length += packed[at]
            at += 1
        if at >= end:
            return None
        start = len(out) - ((control & 31) << 8) - packed[at] - 1
        at += 1
        if start < 0:
            return None
        for i in range(start, start + length + 2):  # source and target may overlap
            out.append(out[i])
        if len(out) > size:
            return None
    return bytes(out) if len(out) == size else None
