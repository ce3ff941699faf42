"""Real scans: stems that are there, diameters that were taped. Skipped where the recordings are absent."""

from __future__ import annotations

import os
import re
import zipfile
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from services.detector.detect import detect_trees
from services.detector.model import DetectionResult
from services.detector.readers import read_cloud
from services.detector.vertical import find_vertical

DATA = Path(os.environ.get("TREEDOCK_DATA") or Path(__file__).parents[3] / "shared" / "data") / "clouds"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"the recordings are not here: {DATA}")

HILL_STEMS_XZ = (
    (-0.07, 0.76), (0.60, 2.22), (2.40, 2.11), (-4.18, -0.57), (4.10, -0.62), (-5.93, 0.41), (5.59, -0.47), (-6.67, -1.86),
    (6.65, 0.66), (7.56, -1.90), (8.45, -3.10),
)  # fmt: skip
"""By eye, from the top view of 0.5..2.2 m above ground."""


def _detect(name: str, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> DetectionResult:
    return detect_trees(read_cloud(DATA / name).points_m, up)


def test_stems_on_a_hill() -> None:
    trunks = _detect("iLiDAR_trees_on_hill.laz", (0.0, 1.0, 0.0)).trunks
    found = [
        any(np.hypot(t.base_m[0] - x, t.base_m[2] - z) < 0.35 for t in trunks) for x, z in HILL_STEMS_XZ
    ]  # fmt: skip
    assert sum(found) >= 10
    assert len(trunks) - sum(found) == 0, "a bush was taken for a tree"


def test_vertical_of_the_hill_is_found() -> None:
    assert find_vertical(read_cloud(DATA / "iLiDAR_trees_on_hill.laz").points_m).up == (0.0, 1.0, 0.0)


def test_pine_diameter() -> None:
    (t,) = _detect("TreeLS_pine.laz").trunks
    assert 200.0 * t.radius_m == pytest.approx(25.3, abs=0.5)
    assert t.radius_height_m == pytest.approx(1.3)


def test_four_trunks_without_ground() -> None:
    result = _detect("TLS_to_FDS_test_trunks.laz")
    assert not result.ground.seen
    assert sorted(round(200 * t.radius_m) for t in result.trunks) == pytest.approx([21, 35, 42, 45], abs=2)


def test_plantation() -> None:
    trunks = _detect("TreeLS_square.laz").trunks
    assert 28 <= len(trunks) <= 33
    assert all(0.05 < t.radius_m < 0.22 for t in trunks)


def test_undergrowth_gives_few_thick_ghosts() -> None:
    trunks = _detect("spanner_MLS_Clip.laz").trunks
    assert 20 <= len(trunks) <= 36
    assert all(t.radius_m < 0.32 for t in trunks)


def _taped_cm() -> dict[int, float]:
    """Read tree number and taped diameter from the workbook (columns by their headings)."""
    names = {"m": "http://schemas.openxmlformats.org/spreadsheetml/2006/main"}
    with zipfile.ZipFile(DATA / "treescope" / "dataset_newdev_train.xlsx") as book:
        strings = ["".join(i.itertext()) for i in ET.fromstring(book.read("xl/sharedStrings.xml"))]
        sheet = ET.fromstring(book.read("xl/worksheets/sheet1.xml"))
    rows: list[dict[str, str]] = []
    for row in sheet.iterfind(".//m:row", names):
        cells: dict[str, str] = {}
        for cell in row:
            value = cell.findtext("m:v", None, names)
            column = re.match("[A-Z]+", cell.get("r", ""))
            if value is not None and column:
                cells[column.group()] = strings[int(value)] if cell.get("t") == "s" else value
        rows.append(cells)
    heading = {text: column for column, text in rows[0].items()}
    tree, taped = heading["filename"], heading["dbh_gt_cm1"]
    return {int(float(r[tree])): float(r[taped]) for r in rows[1:] if tree in r and taped in r}


def test_taped_diameters() -> None:
    errors = []
    for number, taped_cm in _taped_cm().items():
        trunks = _detect(f"treescope/develop_pcds_cropped_tree_{number}_main_trunk.pcd").trunks
        assert len(trunks) == 1, number
        errors.append(200.0 * trunks[0].radius_m - taped_cm)
    assert len(errors) >= 16
    assert float(np.sqrt(np.mean(np.square(errors)))) <= 0.9
    assert abs(float(np.mean(errors))) <= 0.3
