"""GeoPackage and LAZ: other programs read back what was written, equal input gives equal bytes."""

from __future__ import annotations

import io
import shutil
import sqlite3
import struct
import subprocess
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from schemas.trees import Tree, TreeList
from services.evaluate.gis_exports import cloud_laz, trees_gpkg
from tests.examples import all_messages

STAMP_NS = 1_700_000_000 * 10**9


def trees() -> list[Tree]:
    first: Any = next(e for e in all_messages().values() if isinstance(e, TreeList)).trees[0]
    return [first, first.model_copy(update={"id": 9, "x_m": -4.0, "radius_m": 0.2, "suitable": False})]


def test_the_layer_holds_every_tree_at_its_place(tmp_path: Path) -> None:
    path = tmp_path / "trees.gpkg"
    path.write_bytes(trees_gpkg(trees(), STAMP_NS))
    db = sqlite3.connect(path)
    rows = db.execute("SELECT tree_id, diameter_cm, suitable, x_m, y_m, geom FROM trees").fetchall()
    assert [row[:3] for row in rows] == [(7, pytest.approx(24.0), 1), (9, pytest.approx(40.0), 0)]
    for *_, x_m, y_m, blob in rows:
        assert blob[:4] == b"GP\x00\x01"
        assert struct.unpack("<dd", blob[-16:]) == (x_m, y_m)
    assert db.execute("SELECT min_x, max_x, srs_id FROM gpkg_contents").fetchone() == (-4.0, 2.5, -1)
    assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    db.close()


@pytest.mark.skipif(shutil.which("ogrinfo") is None, reason="GDAL's ogrinfo is not installed")
def test_gdal_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "trees.gpkg"
    path.write_bytes(trees_gpkg(trees(), STAMP_NS))
    said = subprocess.run(["ogrinfo", "-al", "-so", str(path)], capture_output=True, text=True, check=True)
    assert "Feature Count: 2" in said.stdout
    assert "Warning" not in said.stderr


@pytest.mark.parametrize("some", [[], trees()])
def test_equal_input_gives_equal_bytes(some: list[Tree]) -> None:
    assert trees_gpkg(some, STAMP_NS) == trees_gpkg(some, STAMP_NS)


@pytest.mark.parametrize("count", [0, 1, 5000])
@pytest.mark.parametrize("coloured", [True, False])
def test_laz_gives_points_and_colours_back(count: int, coloured: bool) -> None:
    rng = np.random.default_rng(count)
    points = rng.uniform(-30.0, 30.0, (count, 3)).astype(np.float32)
    rgb = rng.integers(0, 256, (count if coloured else 0, 3)).astype(np.uint8)
    data = cloud_laz(points, rgb, STAMP_NS)
    assert data == cloud_laz(points, rgb, STAMP_NS)
    las = laspy.read(io.BytesIO(data))
    assert las.header.creation_date is not None
    assert str(las.header.creation_date) == "2023-11-14"
    np.testing.assert_allclose(np.asarray(las.xyz), points, atol=1e-4)
    if coloured:
        np.testing.assert_array_equal(np.asarray(las.red) >> 8, rgb[:, 0])
