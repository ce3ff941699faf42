"""Settings written in another unit than their name says: milliseconds for seconds switch a time limit off without a word.

Where a setting has no upper bound of its own, so many times the default is no choice of anybody's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from pydantic import BaseModel

NOT_FLOWN = frozenset({"simulator", "station", "recorder", "preview", "fine", "clock_ahead_s"})
"""Sections that nobody flies by: there an hour may be a day."""
_UNITS = {
    "_rad": (50.0, 0.05, "radians", "degrees"),
    "_m": (90.0, 0.1, "metres", "centimetres or millimetres"),
    "_s": (500.0, 0.1, "seconds", "milliseconds"),
}
"""What a setting's name ends in: as many times the default as a slip of the unit makes at least (57, 100, 1000), less a little; the
least default that says what is usual (a threshold of millimetres may well be chosen a hundred times as large); the unit; the slip."""
_RATES = ("_per_m", "_per_s", "_inverse_m", "_px_s", "_m_s", "_rad_s")
"""Ends of names that are no lengths or times."""


def slip(defaults: BaseModel, config: BaseModel, key: str) -> str:
    """Return why the value of a setting (its dotted ``key``) cannot be meant, empty when it can."""
    *sections, leaf = key.split(".")
    for section in sections:
        defaults, config = getattr(defaults, section), getattr(config, section)
    value, default, unit = getattr(config, leaf), getattr(defaults, leaf), _unit(leaf)
    if any(isinstance(v, float) and not math.isfinite(v) for v in (value if isinstance(value, Iterable) else [value])):
        return "a number that is finite is expected"
    if not (unit and default and isinstance(value, int | float) and isinstance(default, int | float)):
        return ""
    factor, least, meant, slipped = _UNITS[unit]
    if abs(default) < least:
        return ""
    if key.partition(".")[0] in NOT_FLOWN or _bounded(defaults, leaf) or abs(value) < factor * abs(default):
        return ""
    return f"that is {abs(value / default):.0f} times the default {default:g}; {meant} are meant, not {slipped}"


def _unit(name: str) -> str:
    return "" if name.endswith(_RATES) else next((unit for unit in _UNITS if name.endswith(unit)), "")


def _bounded(tree: BaseModel, leaf: str) -> bool:
    bounds = type(tree).model_fields[leaf].metadata
    return any(getattr(bound, "le", None) is not None or getattr(bound, "lt", None) is not None for bound in bounds)
