"""Is a JPEG whole? Walks its entropy-coded data without making pixels of it (ITU-T T.81, annexes B and F).

OpenCV's decoder paints what it cannot read grey, and goes on. A stream that was damaged anywhere nearly always loses
its step: a code that no table has, a coefficient beyond the block's 64, another number of bits at the end than the image
has blocks for, or a block with more energy than 64 pixels of 0..255 can have (Parseval). All are found here. A flipped
bit that keeps the step and gives a possible picture is found by nobody.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

_EOI, _SOS, _DQT, _DHT, _DRI, _SOF2 = 0xD9, 0xDA, 0xDB, 0xC4, 0xDD, 0xC2
_SEQUENTIAL = (0xC0, 0xC1)
_FRAMES = (*_SEQUENTIAL, _SOF2)
_ALONE = (0x01, *range(0xD0, 0xD8))
"""Markers without a length: TEM and the restarts."""
_LUT_BITS = 10
_LARGEST_NORM = 1024.0
"""Of a block's coefficients: 64 pixels that are all 128 off the middle (T.81 A.3.3: the transform is orthonormal)."""
_NORM_SLACK = 1.1
_WHOLE, _BAD_CODE, _BAD_RUN, _TOO_SHORT, _TOO_LONG, _NO_RESTART, _TOO_STRONG = range(7)
_FAULTS = {
    _BAD_CODE: "a code that its tables do not have",
    _BAD_RUN: "a coefficient beyond its block",
    _TOO_SHORT: "its data end early",
    _TOO_LONG: "data are left over behind its last block",
    _NO_RESTART: "a restart marker is missing or out of turn",
    _TOO_STRONG: "a block that no picture has",
}


@dataclass(slots=True)
class _Header:
    """What the markers before a scan said."""

    frame: int = 0
    width: int = 0
    height: int = 0
    restart: int = 0
    sampling: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Component -> (horizontal, vertical) sampling factor."""
    quantiser: dict[int, int] = field(default_factory=dict)
    """Component -> its quantisation table."""
    steps: dict[int, Ints] = field(default_factory=dict)
    """Quantisation table -> its 64 steps in zigzag order."""
    tables: dict[int, Ints] = field(default_factory=dict)
    """(class << 4 | id) -> decoding table."""


def jpeg_fault(data: bytes | bytearray | memoryview) -> str:
    """Return what is wrong with a JPEG, empty for a whole one.

    Baseline and extended sequential images are walked to their last block; of progressive ones, only the markers are
    checked.
    """
    array = np.frombuffer(data, np.uint8)
    header = _Header()
    scans = 0
    try:
        position = 2
        while True:
            marker, position = _next_marker(array, position)
            if marker == _EOI:
                return "" if scans else "it holds no image data"
            if marker in _ALONE:
                continue
            length = int(array[position]) << 8 | int(array[position + 1])
            body = array[position + 2 : position + length].tobytes()
            if length < 2 or len(body) != length - 2:
                return "truncated JPEG: a marker's segment goes beyond the file"
            position += length
            if marker == _SOS:
                fault, position = _scan(array, position, body, header)
                if fault:
                    return fault
                scans += 1
            else:
                _read_segment(marker, body, header)
    except (IndexError, struct.error, KeyError, ValueError):
        return f"truncated JPEG: no end marker in {len(array)} bytes"


def _next_marker(array: Bytes, position: int) -> tuple[int, int]:
    """Return the next marker's code and the position behind it; raise IndexError at the end of the data."""
    if array[position] != 0xFF:
        raise ValueError("no marker where one belongs")
    while array[position] == 0xFF:
        position += 1
    return int(array[position]), position + 1


def _read_segment(marker: int, body: bytes, header: _Header) -> None:
    if marker == _DRI:
        (header.restart,) = struct.unpack_from(">H", body)
    elif marker == _DHT:
        for kind, table in _huffman_tables(body):
            header.tables[kind] = table
    elif marker == _DQT:
        header.steps.update(_quantisation_tables(body))
    elif 0xC0 <= marker <= 0xCF and marker != 0xC8 and marker != 0xCC:
        header.frame = marker
        _, header.height, header.width, count = struct.unpack_from(">BHHB", body)
        for k in range(count):
            name, factors = body[6 + 3 * k], body[7 + 3 * k]
            header.sampling[name] = (factors >> 4, factors & 15)
            header.quantiser[name] = body[8 + 3 * k]


def _quantisation_tables(body: bytes) -> Iterator[tuple[int, Ints]]:
    at = 0
    while at < len(body):
        wide, name = body[at] >> 4, body[at] & 15
        size = 128 if wide else 64
        steps = np.frombuffer(body[at + 1 : at + 1 + size], ">u2" if wide else np.uint8)
        if len(steps) != 64:
            raise ValueError("a broken quantisation table")
        yield name, steps.astype(np.int64)
        at += 1 + size


def _huffman_tables(body: bytes) -> Iterator[tuple[int, Ints]]:
    at = 0
    while at < len(body):
        counts = body[at + 1 : at + 17]
        total = sum(counts)
        if len(counts) != 16 or at + 17 + total > len(body):
            raise ValueError("a broken Huffman table")
        yield body[at], _decoding_table(counts, body[at + 17 : at + 17 + total])
        at += 17 + total


@lru_cache(maxsize=32)
def _decoding_table(counts: bytes, symbols: bytes) -> Ints:
    """Return one array: a look-up of the first ``_LUT_BITS`` bits, then per length (largest code, offset), then symbols.

    T.81 annex C (codes by length) and F.2.2.3 (decoding).
    """
    lut = np.zeros(1 << _LUT_BITS, np.int64)
    limits = np.full((17, 2), -1, np.int64)
    code = index = 0
    for length in range(1, 17):
        for _ in range(counts[length - 1]):
            if length <= _LUT_BITS:
                first = code << (_LUT_BITS - length)
                lut[first : first + (1 << (_LUT_BITS - length))] = length << 8 | symbols[index]
            limits[length] = code, index - code
            code, index = code + 1, index + 1
        code <<= 1
    padded = np.zeros(256, np.int64)
    padded[: len(symbols)] = np.frombuffer(symbols, np.uint8)[:256]
    return np.concatenate([lut, limits.ravel(), padded])


def _scan(array: Bytes, position: int, body: bytes, header: _Header) -> tuple[str, int]:
    """Return (fault or nothing, position of the marker behind the scan)."""
    names = [(body[1 + 2 * k], body[2 + 2 * k]) for k in range(body[0])]
    wanted = {table for _, ids in names for table in (ids >> 4, 0x10 | (ids & 15))}
    # motion JPEG leaves the usual tables out, and a height of zero is told after the scan: decoders know, we only skip
    if header.frame not in _SEQUENTIAL or not wanted <= header.tables.keys() or header.height == 0:
        return "", _skip_scan(array, position)
    h_max = max(h for h, _ in header.sampling.values())
    v_max = max(v for _, v in header.sampling.values())
    tables, blocks, steps = [], [], []
    for name, ids in names:
        h, v = header.sampling[name]
        tables.append([header.tables[ids >> 4], header.tables[0x10 | (ids & 15)]])
        steps.append(header.steps[header.quantiser[name]])
        blocks.append(h * v if len(names) > 1 else 1)
    width, height = header.width, header.height
    if len(names) == 1:  # a scan of one component has only the blocks that its own samples need (T.81 A.2.2)
        h, v = header.sampling[names[0][0]]
        width, height = _up(width * h, h_max), _up(height * v, v_max)
        h_max, v_max = 1, 1
    units = _up(width, 8 * h_max) * _up(height, 8 * v_max)
    code, position, done = walk(
        array, position, np.array(tables), np.array(steps), np.array(blocks), units, header.restart
    )
    if code != _WHOLE:
        return f"damaged JPEG: {_FAULTS[code]} (part {done} of {units})", position
    return "", position


def _up(a: int, b: int) -> int:
    """Return a / b, rounded up."""
    return (a + b - 1) // b


def _skip_scan(array: Bytes, position: int) -> int:
    """Return where the next marker stands that is no restart."""
    while True:
        if array[position] == 0xFF and array[position + 1] not in (0x00, *_ALONE):
            return position
        position += 1


@njit(cache=True, nogil=True, inline="always")
def _code(table: Ints, window: int) -> tuple[int, int]:
    """Return (length, symbol) of the code that a 16 bit window begins with; length 0: there is none."""
    entry = table[window >> (16 - _LUT_BITS)]
    if entry > 0:
        return entry >> 8, entry & 255
    limits_at = 1 << _LUT_BITS
    for length in range(_LUT_BITS + 1, 17):
        code = window >> (16 - length)
        largest = table[limits_at + 2 * length]
        if largest >= 0 and code <= largest:
            index = code + table[limits_at + 2 * length + 1]
            if 0 <= index < 256:
                return length, table[limits_at + 34 + index]
            return 0, 0
    return 0, 0


@njit(cache=True, nogil=True, inline="always")
def _refill(data: Bytes, position: int, bits: int, held: int) -> tuple[int, int, int]:
    """Take in bytes until 32 bits (one code and what follows it) are held or a marker comes."""
    while held < 32 and position < data.size:
        byte = data[position]
        if byte == 0xFF:
            if position + 1 >= data.size or data[position + 1] != 0:
                break
            position += 1
        position += 1
        bits = ((bits & 0xFFFFFFFF) << 8) | byte
        held += 8
    return position, bits, held


@njit(cache=True, nogil=True)
def _block(
    data: Bytes, position: int, bits: int, held: int, tables: NDArray[np.int64], steps: Ints, dc: int
) -> tuple[int, int, int, int, int, float]:
    """Walk one block; return (fault, position, bits, held, its DC value, the square of its coefficients' norm)."""
    k, energy = 0, 0.0
    table, further = tables[0], tables[1]
    while k < 64:
        if held < 32:
            position, bits, held = _refill(data, position, bits, held)
        # behind the data there are zeros; who uses them has ended early
        window = ((bits >> (held - 16)) if held >= 16 else (bits << (16 - held))) & 0xFFFF
        length, symbol = _code(table, window)
        if length == 0:
            return (_BAD_CODE if held >= 16 else _TOO_SHORT), position, bits, held, dc, energy
        extra = symbol & 15
        held -= length + extra
        if held < 0:
            return _TOO_SHORT, position, bits, held, dc, energy
        value = (bits >> held) & ((1 << extra) - 1)
        if extra > 0 and value < 1 << (extra - 1):
            value -= (1 << extra) - 1
        if k == 0:
            if symbol > 15:
                return _BAD_CODE, position, bits, held, dc, energy
            dc += value
            energy = float(dc * steps[0] * dc * steps[0])
            k, table = 1, further
            continue
        if extra == 0 and symbol != 0xF0:
            break
        k += symbol >> 4
        if k > 63:
            return _BAD_RUN, position, bits, held, dc, energy
        energy += float(value * steps[k] * value * steps[k])
        k += 1
    return _WHOLE, position, bits, held, dc, energy


@njit(cache=True, nogil=True)
def walk(
    data: Bytes, position: int, tables: NDArray[np.int64], steps: NDArray[np.int64], blocks: Ints, units: int,
    restart: int,
) -> tuple[int, int, int]:  # fmt: skip
    """Walk one sequential scan.

    Args:
        data: the file.
        position: of the scan's first byte.
        tables: (C, 2, n) decoding tables, DC and AC of each component.
        steps: (C, 64) quantisation steps.
        blocks: (C,) blocks of each component in a unit.
        units: how many units (MCUs) the scan must have.
        restart: units between restart markers, 0 for none.

    Returns:
        (fault code, position behind the last byte used, units walked).
    """
    bits, held, turn = 0, 0, 0
    dc = np.zeros(blocks.size, np.int64)
    largest = np.empty(blocks.size)
    for c in range(blocks.size):
        rounding = 0.5 * math.sqrt(np.sum(steps[c] * steps[c]))
        largest[c] = (_NORM_SLACK * _LARGEST_NORM + rounding) ** 2
    for unit in range(units):
        if restart > 0 and unit > 0 and unit % restart == 0:
            if held >= 8 or position + 1 >= data.size or data[position] != 0xFF or data[position + 1] != 0xD0 + turn:
                return _NO_RESTART, position, unit
            position, turn, held = position + 2, (turn + 1) % 8, 0
            dc[:] = 0
        for c in range(blocks.size):
            for _ in range(blocks[c]):
                fault, position, bits, held, dc[c], energy = _block(
                    data, position, bits, held, tables[c], steps[c], dc[c]
                )
                if fault == _WHOLE and energy > largest[c]:
                    fault = _TOO_STRONG
                if fault != _WHOLE:
                    return fault, position, unit
    at_marker = position + 1 < data.size and data[position] == 0xFF and data[position + 1] != 0
    return (_WHOLE if held < 8 and at_marker else _TOO_LONG), position, units


def warm() -> None:
    """Compile or load the kernels."""
    tables = np.zeros((1, 2, (1 << _LUT_BITS) + 34 + 256), np.int64)
    walk(np.zeros(4, np.uint8), 0, tables, np.ones((1, 64), np.int64), np.ones(1, np.int64), 1, 0)
