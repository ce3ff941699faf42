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
    import laspy

    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = POINTS.T.astype(float)
    path = tmp_path / f"a{suffix}"
    las.write(path)
    assert read_cloud(path).points_m == pytest.approx(POINTS, abs=1e-3)
    whole = path.read_bytes()
    for share in (0.1, 0.5, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=path.name):
            read_cloud(path)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.9])
def test_cut_files_are_one_clear_line(name: str, share: float, tmp_path: Path) -> None:
    path = tmp_path / name
    data = FILES[name]
    path.write_bytes(data[: int(share * len(data))])
    if name == "a.xyz" and share >= 0.05:
        assert len(read_cloud(path).points_m) < len(POINTS)  # lines have no count to be measured by
        return
    with pytest.raises(InputError) as caught:
        read_cloud(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "packed.pcd"])
def test_few_nans_are_counted_many_refused(name: str, tmp_path: Path) -> None:
    make = {"a.ply": _ply, "a.pcd": lambda p: _pcd(p, "binary"), "packed.pcd": lambda p: _pcd(p, "binary_compressed")}[
        name
    ]
    path = tmp_path / name
    some = POINTS.copy()
    some[:20] = np.nan
    path.write_bytes(make(some))
    assert read_cloud(path).refused == 20
    assert len(read_cloud(path).points_m) == 180
    some[:] = np.nan
    path.write_bytes(make(some))
    with pytest.raises(InputError, match="NaN"):
        read_cloud(path)


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("no.ply", b"hello", "not a PLY"), ("e.ply", _ply(POINTS[:0]), "no points"), ("e.xyz", b"", "no line"),
        ("f.foo", b"x", "unknown kind"), ("g.xyz", b"1 2 3\n4 5\n", "not x y z"), ("h.pcd", b"junk\n", "not a PCD"),
        ("i.las", b"LASF", "not a whole LAS"), ("j.ply", _ply(POINTS).replace(b"float z", b"float w"), "x, y and z"),
    ],
)  # fmt: skip
def test_faults_are_named(name: str, data: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(InputError, match=words):
        read_cloud(path)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_cloud(tmp_path / "none.ply")
    with pytest.raises(InputError, match="not a file"):
        read_cloud(tmp_path)


def test_lzf_back_references() -> None:
    # literal "abc", then 7 bytes from three back (length code 5 + 2), overlapping
    assert lzf_decompress(bytes([2]) + b"abc" + bytes([(5 << 5) | 0, 2]), 10) == b"abcabcabca"


@given(st.binary(max_size=300), st.integers(0, 400))
def test_lzf_survives_anything(data: bytes, size: int) -> None:
    out = lzf_decompress(data, size)
    assert out is None or len(out) == size


def test_our_own_ply_tells_from_where_it_was_seen(tmp_path: Path) -> None:
    poses = np.stack([level_camera([0.0, 0.0, 1.5], 0.0), level_camera([1.0, -2.0, 1.5], 2.0)])
    index = np.arange(len(POINTS)) % 2
    data = ply_bytes(POINTS.astype(np.float32), np.zeros((0, 3), np.uint8), Viewpoints(index.astype(np.uint16), poses))
    (tmp_path / "own.ply").write_bytes(data)
    views = read_cloud(tmp_path / "own.ply").views
    assert views is not None
    assert views.rotations is not None
    assert views.index.tolist() == index.tolist()
    assert views.origins_m == pytest.approx(poses[:, :3, 3], abs=1e-6)
    assert views.rotations == pytest.approx(poses[:, :3, :3], abs=1e-6)
    (tmp_path / "odd.ply").write_bytes(data.replace(b"element viewpoint 2", b"element viewpoint 1"))
    assert read_cloud(tmp_path / "odd.ply").views is None


@pytest.mark.parametrize(("at", "form", "words"), [(100, "<I", "records"), (107, "<I", "points")])
def test_a_header_that_announces_more_than_the_file_holds_is_refused_at_once(
    tmp_path: Path, at: int, form: str, words: str
) -> None:
    """Found by fuzzing: four thousand million records kept laspy reading, and took 2.5 GB in a minute."""
    data = bytearray(las(compressed=False))
    data[at : at + 4] = struct.pack(form, 0xFFFF_FFF0)
    (tmp_path / "a.las").write_bytes(data)
    with pytest.raises(InputError, match=f"announces .* {words}"):
        read_cloud(tmp_path / "a.las")


@pytest.mark.parametrize("at_the_end", [False, True])
def test_a_laz_file_that_announces_more_chunks_than_it_holds_is_refused(tmp_path: Path, *, at_the_end: bool) -> None:
    """Found by fuzzing: the decompressor made room for four thousand million chunks, and the process was aborted."""
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


def test_a_laz_file_whose_decompressor_is_aborted_is_refused(tmp_path: Path) -> None:
    """Found by fuzzing: with a damaged size of an item the Rust decompressor ends the process that it runs in."""
    path, data = tmp_path / "cloud.laz", bytearray(las(compressed=True))
    data[295:297] = b"\xff\xff"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"cloud\.laz: not a whole LAS/LAZ file"):
        read_cloud(path)


def test_a_decompressor_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "cloud.laz"
    path.write_bytes(las(compressed=True))
    monkeypatch.setattr("services.detector.readers_las._PATIENCE_S", 0.01)
    with pytest.raises(InputError, match="cannot be unpacked"):
        read_cloud(path)
