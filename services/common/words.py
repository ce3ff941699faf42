"""Words for people."""

from __future__ import annotations


def plural(number: int, word: str) -> str:
    """Return ``word`` as it stands after ``number``: 1 tree, 2 trees, 0 trees."""
    return word if number == 1 else f"{word}s"
