"""Lines of the TUM format's text files, with faults named by file and line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

from services.common.errors import InputError


@dataclass(frozen=True, slots=True)
class Row:
    """The fields of one line."""

    line: int
    fields: tuple[str, ...]

    def number(self, column: int, path: Path) -> float:
        """Return a field as a finite number, or raise InputError."""
        try:
            value = float(self.fields[column])
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{path}:{self.line}: {self.fields[column]!r} is not a finite number")
        return value


def read_rows(path: Path, columns: int, what: str) -> list[Row]:
    """Return the lines that are not comments, split at blanks (or commas).

    Raises:
        InputError: the file is missing, no text, or a line has another number of fields.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = tuple(line.replace(",", " ").split())
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) != columns:
            raise InputError(f"{path}:{number}: {len(fields)} fields, expected {columns}: {what}")
        rows.append(Row(number, fields))
    return rows


def stamp_ns_of(row: Row, column: int, path: Path) -> int:
    """Return a stamp in seconds as integer nanoseconds, exactly.

    Raises:
        InputError: it is no time, or negative.
    """
    text = row.fields[column]
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = Decimal("NaN")
    if not seconds.is_finite() or not 0 <= seconds < 2**33:
        raise InputError(f"{path}:{row.line}: the stamp {text!r} is not a time in seconds")
    return int(seconds * 1_000_000_000)
