"""The fault matrix on paper is the one in code, and complete."""

from __future__ import annotations

from services.cli.service_command import OPTIONAL, SERVICES
from services.evaluate.faults.page import PAGE, rendered
from services.evaluate.faults.rows import ROWS


def test_the_page_shows_the_rows_as_they_are() -> None:
    assert PAGE.read_text(encoding="utf-8") == rendered(), "run: python -m services.evaluate.faults.page"


def test_every_process_is_killed_and_stopped() -> None:
    names = {row.name for row in ROWS}
    assert len(names) == len(ROWS)
    for service in {*SERVICES, *OPTIONAL, "station"} - {"simulator"}:
        assert {f"kill -9 {service}", f"SIGSTOP {service}"} <= names
    for service in ("camera", "slam", "mapper", "detector", "refiner"):
        assert {f"kill -9 {service} (real)", f"SIGSTOP {service} (real)"} <= names


def test_every_row_is_on_the_page_with_what_must_hold() -> None:
    assert all(row.holds and row.done and f"`{row.name}`" in rendered() for row in ROWS)
