"""The page's colours in sunlight: what is read against what it stands on, by WCAG 2's contrast ratio."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

TEXT, MARK = 4.5, 3.0
"""WCAG 2.1, 1.4.3 and 1.4.11: words of normal size, and marks that carry a meaning."""
PAIRS = (
    ("ink", "surface", 12.0), ("ink", "bg", 12.0), ("ink", "sunk", 12.0), ("soft", "surface", 7.0), ("soft", "sunk", 7.0), ("map-ink", "map", 12.0),
    ("brand", "surface", TEXT), ("info", "surface", TEXT), ("good", "good-bg", TEXT), ("warn", "warn-bg", TEXT), ("bad", "bad-bg", TEXT),
    ("good", "surface", TEXT), ("warn", "surface", TEXT), ("bad", "surface", TEXT), ("go-ink", "go", TEXT), ("stop-ink", "stop", TEXT),
    ("pause-ink", "pause", TEXT), ("stop", "surface", TEXT), ("focus", "surface", MARK), ("focus", "bg", MARK), ("tree", "map", MARK),
    ("tree-un", "map", MARK), ("tree-visited", "map", MARK), ("tree-target", "map", MARK), ("craft", "map", MARK), ("line-strong", "surface", MARK),
)  # fmt: skip


def themes() -> dict[str, dict[str, str]]:
    css = (files("services.station") / "static" / "app.css").read_text()
    light, dark = re.findall(r":root(?:\[data-theme=\"dark\"\])? \{(.*?)\n\}", css, re.DOTALL)[:2]
    found = {
        name: dict(re.findall(r"--([a-z0-9-]+): (#[0-9a-f]{6});", block))
        for name, block in (("light", light), ("dark", dark))
    }
    assert all(len(theme) > 20 for theme in found.values())
    return found


def luminance(colour: str) -> float:
    parts = [int(colour[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return sum(w * c for w, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_everything_is_readable(theme: str) -> None:
    colours = themes()[theme]
    poor = []
    for front, back, least in PAIRS:
        a, b = sorted((luminance(colours[front]), luminance(colours[back])))
        ratio = (b + 0.05) / (a + 0.05)
        if ratio < least:
            poor.append(f"{front} on {back}: {ratio:.1f}, wanted {least}")
    assert poor == []
