"""Every block of settings that the documents show is accepted as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from services.common.config_loader import load

ROOT = Path(__file__).parents[2]


def _blocks() -> list[tuple[str, str]]:
    found = []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for number, block in enumerate(re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)):
            found.append((f"{page.relative_to(ROOT)}:{number}", block))
    return found


@pytest.mark.parametrize(("place", "block"), _blocks(), ids=[place for place, _ in _blocks()])
def test_a_block_of_the_documents_is_accepted(tmp_path: Path, place: str, block: str) -> None:
    file = tmp_path / "shown.toml"
    file.write_text(block, encoding="utf-8")
    assert load(file, environ={}, system_directory=tmp_path / "none").origins, place


def test_there_are_such_blocks() -> None:
    assert len(_blocks()) >= 2
