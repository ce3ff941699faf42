"""docs/safety.md names a test for every loss, and that test is there."""

from __future__ import annotations

import re
from fnmatch import filter as matching
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_COLUMNS = 6


def _rows() -> list[list[str]]:
    lines = (ROOT / "docs" / "safety.md").read_text().splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith("| loss |"))
    rows = []
    for line in lines[begin + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split(" | ")])
    return rows


def _tests() -> set[str]:
    sources = [path.read_text() for path in (ROOT / "tests").rglob("test_*.py")]
    return {name for source in sources for name in re.findall(r"^def (test_\w+)", source, re.MULTILINE)}


def test_the_table_covers_the_contract() -> None:
    """design.md section 6 names these losses; each has a row of its own."""
    losses = [row[0] for row in _rows()]
    for wanted in ("operator took over", "slam lost", "pose jump", "camera silent", "target lost", "trees list stale",
                   "dead or hung", "autopilot link lost", "ground link lost", "battery low", "geofence", "obstacle",
                   "hold, abort, land commands"):  # fmt: skip
        assert any(wanted in loss for loss in losses), wanted


@pytest.mark.parametrize("row", _rows(), ids=lambda row: str(row[0]))
def test_every_row_says_everything_and_its_tests_exist(row: list[str]) -> None:
    assert len(row) == _COLUMNS
    assert all(row)
    names = re.findall(r"`([^`]+)`", row[-1])
    known = _tests()
    found = [name for name in names if name.startswith(("test_", "tests/"))]
    assert found, "no test named"
    for name in found:
        there = (ROOT / name).is_file() if "/" in name else bool(matching(known, name.split("[")[0]))
        assert there, f"{name} is named in docs/safety.md and does not exist"
