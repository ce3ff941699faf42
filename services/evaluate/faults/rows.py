"""THE fault matrix: every row, in the order in which it is run. docs/faults.md is written from it."""

from __future__ import annotations

from services.evaluate.faults import chain_rows, harms, killing, network_rows
from services.evaluate.faults.model import Row

ROWS: tuple[Row, ...] = (*killing.rows(), *chain_rows.rows(), *harms.rows(), *network_rows.rows())


def find(name: str) -> Row:
    """Return a row by its name.

    Raises:
        KeyError: there is none.
    """
    return {row.name: row for row in ROWS}[name]
