"""How much memory a process may lock, as its kernel says."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.common.memlock import ENOUGH_BYTES, UNLIMITED, lockable_bytes, too_little

LIMITS = "Limit                     Soft Limit           Hard Limit           Units     \n"
NONE, IPC_LOCK = "0000000000000000", "0000000000004000"


@pytest.mark.parametrize(
    ("soft", "capabilities", "found"),
    [("8388608", NONE, 8388608), ("unlimited", NONE, UNLIMITED), ("8388608", IPC_LOCK, UNLIMITED),
     ("8388608", "000001fffeffffff", UNLIMITED)],
)  # fmt: skip
def test_limit_and_capability_are_both_looked_at(tmp_path: Path, soft: str, capabilities: str, found: int) -> None:
    (tmp_path / "7").mkdir()
    (tmp_path / "7/status").write_text(f"Name:\tpython\nCapEff:\t{capabilities}\n")
    (tmp_path / "7/limits").write_text(f"{LIMITS}Max locked memory         {soft:<20} {soft:<20} bytes\n")
    assert lockable_bytes(7, tmp_path) == found
    assert too_little(found) == (found == 8388608)


def test_what_cannot_be_told_is_no_fault(tmp_path: Path) -> None:
    assert lockable_bytes(7, tmp_path) is None
    assert not too_little(None)
    assert not too_little(ENOUGH_BYTES)
    assert lockable_bytes() is not None
