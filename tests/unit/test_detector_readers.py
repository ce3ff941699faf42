from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.common.errors import InputError
from services.common.geometry import level_camera
from services.detector.readers import read_cloud
from services.detector.readers_pcd import lzf_decompress
from services.evaluate.exports import Viewpoints, ply_bytes
from tests.fuzz.seeds import las

POINTS = np.round(np.random.default_rng(1).normal(0.0, 3.0, (200, 3)), 3).astype(np.float32)


def _ply(points: np.ndarray, form: str = "binary_little_endian") -> bytes:
    head = f"ply\nformat {form} 1.0\ncomment x\nelement vertex {len(points)}\nproperty uchar red\n"
    head += "property float x\nproperty float y\nproperty float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    if form == "ascii":
        return (head + "".join(f"7 {x} {y} {z}\n" for x, y, z in points)).encode()
    order = "<" if "little" in form else ">"
    table = np.zeros(len(points), dtype=[("r", "u1"), ("x", order + "f4"), ("y", order + "f4"), ("z", order + "f4")])
    for i, axis in enumerate("xyz"):
        table[axis] = points[:, i]
    return head.encode() + table.tobytes()


def _pcd(points: np.ndarray, form: str) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {form}\n"
    table = np.hstack([points, np.ones((len(points), 1), dtype=np.float32)]).astype("<f4")
    if form == "ascii":
        return (head + "".join(" ".join(str(v) for v in row) + "\n" for row in table)).encode()
    if form == "binary":
        return head.encode() + table.tobytes()
    raw = table.T.tobytes()
    packed = _lzf(raw)
    return head.encode() + struct.pack("<II", len(packed), len(raw)) + packed


def _lzf(raw: bytes) -> bytes:
    """Literal runs only: the plainest valid stream."""
    return b"".join(bytes([len(raw[i : i + 32]) - 1]) + raw[i : i + 32] for i in range(0, len(raw), 32))


def _xyz(points: np.ndarray) -> bytes:
    return ("x,y,z\n" + "".join(f"{x},{y},{z},5\n" for x, y, z in points)).encode()


FILES = {
    "a.ply": _ply(POINTS), "big.ply": _ply(POINTS, "binary_big_endian"), "text.ply": _ply(POINTS, "ascii"),
    "a.pcd": _pcd(POINTS, "binary"), "text.pcd": _pcd(POINTS, "ascii"), "packed.pcd": _pcd(POINTS, "binary_compressed"),
    "a.xyz": _xyz(POINTS),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_reads(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(FILES[name])
    cloud = read_cloud(path)
    assert cloud.refused == 0
    assert cloud.points_m == pytest.approx(POINTS, abs=1e-6)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_reads_las(suffix: str, tmp_path: Path) -> None:
    path, data = tmp_path / "cloud.laz", bytearray(las(compressed=True))
    path.write_bytes(data)
    assert len(read_cloud(path).points_m) > 0
    (begin,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, begin)
    struct.pack_into("<I", data, table + 4, 0xFFFFFFFF)
    if at_the_end:
        struct.pack_into("<q", data, begin, -1)
        data += struct.pack("<q", table)
    path.write_bytes(data)
    with pytest.raises(InputError, match="announces 4294967295 chunks in"):
        read_cloud(path)
