"""PCD files: ascii, binary and LZF-compressed."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from services.common.errors import InputError
from services.detector.model import Floats
from services.detector.readers_rows import MAX_HEADER, binary_table, check_count, coordinates, text_rows

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


def read_pcd(path: Path) -> Floats:
    """Return the points (N, 3).

    Raises:
        InputError: not a PCD, cut short, damaged, or without plain coordinates.
    """
    data = path.read_bytes()
    header = _pcd_header(path, data)
    check_count(path, header.points)
    if header.form == "ascii":
        starts = np.concatenate([[0], np.cumsum(header.repeats)])
        columns = tuple(int(starts[header.names.index(axis)]) for axis in "xyz")
        return text_rows(path, data[header.body :], 0, header.points, columns)
    fields = [(n, "<" + k, (r,)) if r != 1 else (n, "<" + k) for n, k, r in zip(_unique(header.names), header.kinds, header.repeats, strict=True)]  # fmt: skip
    if header.form == "binary":
        return coordinates(binary_table(path, data, header.body, np.dtype(fields), header.points))
    return _compressed_rows(path, data, header)


def _unique(names: list[str]) -> list[str]:
    """PCD pads with fields all named ``_``."""
    return [name if names.index(name) == i else f"{name}.{i}" for i, name in enumerate(names)]


def _pcd_header(path: Path, data: bytes) -> _PcdHeader:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = data.find(b"\n", at, MAX_HEADER)
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
