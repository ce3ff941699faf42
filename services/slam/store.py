"""A map's keyframes on disk: an append-only log of records, and beside it the latest map as a whole.

A record is a magic word, its kind, length and CRC-32, then its body. What is torn or damaged anywhere is passed over:
reading goes on at the next magic word. The first record is the header; a file without one is no map. The whole map is
written beside its old one and renamed over it.

Nothing here waits for the disk: a map is taken up again only in the boot in which it was made, and what a process has
written outlives it without that. Mapping would stand still for it, and tracking waits for mapping.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.common.files import make_folder, write_parts, write_whole

F64 = NDArray[np.float64]
Arrays = dict[str, NDArray]

HEADER, KEYFRAME, BEAT, TAKEN = b"H", b"K", b"B", b"T"
FORMAT = 1
_MAGIC = b"\x9dTDK"
_HEAD = struct.Struct("<4sccxxII")
_CLOCK = struct.Struct("<Q")
_NUMBERS = struct.Struct("<iiiqQ12d")
_COLUMNS = (
    ("uv", np.float32, 2), ("octave", np.uint8, 0), ("angle", np.float32, 0), ("desc", np.uint64, 4),
    ("depth", np.float32, 0), ("info", np.float32, 0), ("far", np.bool_, 0),
)  # fmt: skip
_MOST_BODY = 1 << 22


@dataclass(frozen=True, slots=True)
class Header:
    """Whose map it is; all of it must agree before the map is taken up again."""

    map_id: str
    boot: str
    """The machine's boot: its clock of ages starts anew with each."""
    camera: str
    """Intrinsics and what of the configuration shapes the arrays, as one text."""


@dataclass(frozen=True, slots=True)
class StoredKeyframe:
    """One keyframe as it was made."""

    serial: int
    era: int
    """Of the map's frame: turned or bent at a loop, it is another."""
    graph_version: int
    age_ns: int
    """The machine's clock since boot."""
    R: F64
    t: F64
    columns: Arrays
    """Features (N first) by name."""


def encode_keyframe(k: StoredKeyframe) -> bytes:
    """Return the body of a keyframe's record."""
    count = len(k.columns["uv"])
    head = _NUMBERS.pack(k.serial, k.era, count, k.graph_version, k.age_ns, *k.R.ravel(), *k.t)
    return head + b"".join(np.ascontiguousarray(k.columns[name], dtype=kind).tobytes() for name, kind, _ in _COLUMNS)


def decode_keyframe(body: bytes) -> StoredKeyframe:
    """Return the keyframe of a record whose checksum was right."""
    serial, era, count, version, age_ns, *pose = _NUMBERS.unpack_from(body)
    at, columns = _NUMBERS.size, {}
    for name, kind, width in _COLUMNS:
        size = count * max(width, 1)
        flat = np.frombuffer(body, kind, size, at)
        columns[name] = flat.reshape(count, width) if width else flat
        at += flat.nbytes
    R, t = np.array(pose[:9]).reshape(3, 3), np.array(pose[9:])
    return StoredKeyframe(serial, era, version, age_ns, R, t, columns)


def record(kind: bytes, body: bytes) -> bytes:
    """Return a whole record."""
    return _HEAD.pack(_MAGIC, kind, b"\0", len(body), zlib.crc32(kind + body)) + body


def records(data: bytes | mmap.mmap) -> Iterator[tuple[bytes, bytes]]:
    """Yield kind and body of each sound record."""
    at = data.find(_MAGIC)
    while 0 <= at <= len(data) - _HEAD.size:
        _, kind, _, size, check = _HEAD.unpack_from(data, at)
        body = data[at + _HEAD.size : at + _HEAD.size + size] if size <= _MOST_BODY else b""
        if len(body) == size and zlib.crc32(kind + body) == check:
            yield kind, body
            at = data.find(_MAGIC, at + _HEAD.size + size)
        else:
            at = data.find(_MAGIC, at + 1)


@dataclass(slots=True)
class Log:
    """What a log was found to hold."""

    header: Header | None = None
    keyframes: list[StoredKeyframe] = field(default_factory=list)
    last_ns: int = 0
    """The latest sign of life, clock since boot."""
    taken_ns: list[int] = field(default_factory=list)
    """When the map was taken up again."""


class Store:
    """The two files of one folder."""

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self._log = folder / "keyframes.log"
        self._whole = folder / "map.npz"
        self._folder = folder
        self._most_bytes = most_bytes
        self._size = 0
        self.damaged: list[Path] = []
        """Files that were read and are not what was written."""

    @property
    def full(self) -> bool:
        """Whether the log has reached its limit."""
        return self._size >= self._most_bytes

    def begin(self, header: Header) -> None:
        """Throw away what is there and begin the log of a map.

        Raises:
            InputError: the folder cannot be made or written.
        """
        make_folder(self._folder)
        self.end()
        first = record(HEADER, json.dumps({"format": FORMAT, **asdict(header)}).encode())
        write_whole(self._log, first, lasting=False)
        self._size = len(first)

    def append(self, kind: bytes, body: bytes) -> None:
        """Add a record; nothing is added beyond the limit.

        Raises:
            OSError: the disk refused.
        """
        data = record(kind, body)
        if self._size + len(data) > self._most_bytes:
            self._size = self._most_bytes
            return
        handle = os.open(self._log, os.O_WRONLY | os.O_APPEND)
        try:
            os.write(handle, data)
        finally:
            os.close(handle)
        self._size += len(data)

    def keep_only(self, serials: set[int]) -> None:
        """Write the log anew with only the keyframes ``serials``, and how often it was taken up.

        Raises:
            InputError, OSError: the disk refused; the log is as it was.
        """
        with self._log.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            kept = (
                record(kind, body)
                for kind, body in records(data)
                if kind in (HEADER, TAKEN) or (kind == KEYFRAME and _NUMBERS.unpack_from(body)[0] in serials)
            )
            write_parts(self._log, kept, lasting=False)
        self._size = self._log.stat().st_size

    def write_map(self, arrays: Arrays) -> None:
        """Replace the map as a whole.

        Raises:
            InputError: the disk refused; the old one is as it was.
        """
        buffer = BytesIO()
        np.savez(buffer, **arrays)  # type: ignore[arg-type]  # the stub takes allow_pickle for one of them
        body = buffer.getvalue()
        write_whole(self._whole, struct.pack("<I", zlib.crc32(body)) + body, lasting=False)

    def mark(self, kind: bytes, now_ns: int) -> None:
        """Add a sign of life (BEAT), or that the map was taken up again (TAKEN), at the machine's clock since boot.

        Raises:
            OSError: the disk refused.
        """
        self.append(kind, _CLOCK.pack(now_ns))

    def read(self) -> Log:
        """Return what the log holds, from its sound records.

        Raises:
            ValueError: a sound record holds what this version does not write.
        """
        log = Log()
        try:
            data = self._log.read_bytes()
        except OSError:
            return log
        for kind, body in records(data):
            if kind == HEADER and log.header is None:
                log.header = _header(body)
            elif kind == KEYFRAME:
                log.keyframes.append(decode_keyframe(body))
                log.last_ns = max(log.last_ns, log.keyframes[-1].age_ns)
            elif kind in {BEAT, TAKEN}:
                (stamp_ns,) = _CLOCK.unpack(body)
                log.last_ns = max(log.last_ns, stamp_ns)
                log.taken_ns += [stamp_ns] * (kind == TAKEN)
        if log.header is None:  # the first that is written; what is cut off at the end was being written
            self.damaged.append(self._log)
        self._size = len(data)
        return log

    def read_map(self) -> Arrays:
        """Return the map as a whole; empty when there is none that is sound."""
        try:
            data = self._whole.read_bytes()
        except OSError:
            return {}
        if len(data) < 4 or zlib.crc32(data[4:]) != struct.unpack("<I", data[:4])[0]:
            self.damaged.append(self._whole)
            return {}
        with np.load(BytesIO(data[4:]), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}

    def end(self) -> None:
        """Throw the map away: whoever starts next begins anew."""
        for path in (self._log, self._whole):
            with contextlib.suppress(OSError):
                path.unlink()


def _header(body: bytes) -> Header | None:
    fields = json.loads(body)
    return Header(**fields) if fields.pop("format") == FORMAT else None
