"""The report's pictures: the fit lies on the points, lines break where the target changes, all of it is XML."""

from __future__ import annotations

import re
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from schemas.trees import Target, Tree, TreeList
from services.evaluate.report import STYLE, tree_table
from services.evaluate.report_pictures import cross_section_svg, filter_plots_svg
from services.evaluate.sightings import sightings
from tests.examples import all_messages


def example(kind: type) -> Any:
    return next(e for e in all_messages().values() if type(e) is kind)


TREE: Tree = example(TreeList).trees[0].model_copy(update={"x_m": 2.0, "y_m": 1.0, "z_m": 0.3, "radius_m": 0.15})


def ring(tree: Tree, height_m: float, count: int = 900) -> np.ndarray:
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    return np.stack(
        [
            tree.x_m + tree.radius_m * np.cos(angle),
            tree.y_m + tree.radius_m * np.sin(angle),
            np.full(count, tree.z_m + height_m),
        ],
        axis=1,
    ).astype(np.float32)


def numbers(text: str, tag: str, *names: str) -> list[tuple[float, ...]]:
    return [
        tuple(float(element.attrib[name]) for name in names)
        for element in ET.fromstring(text).iter(tag)
        if all(name in element.attrib for name in names)
    ]


def test_the_circle_lies_on_the_slices_points_and_other_heights_are_left_out() -> None:
    wide = TREE.model_copy(update={"radius_m": 0.25})
    svg = cross_section_svg(TREE, np.vstack([ring(TREE, 1.3), ring(wide, 2.0)]))
    circles = numbers(svg, "circle", "cx", "cy", "r")
    fit = max(circles, key=lambda c: c[2])
    radii = [np.hypot(c[0] - fit[0], c[1] - fit[1]) for c in circles if c is not fit]
    assert 300 <= len(radii) <= 1000
    np.testing.assert_allclose(radii, fit[2], atol=0.3)


def test_left_is_left_and_ahead_is_up() -> None:
    one = np.array([[TREE.x_m + 0.1, TREE.y_m + 0.05, TREE.z_m + 1.3]], np.float32)
    svg = cross_section_svg(TREE, one)
    *_, fit = sorted(numbers(svg, "circle", "cx", "cy", "r"), key=lambda c: c[2])
    dot = min(numbers(svg, "circle", "cx", "cy", "r"), key=lambda c: c[2])
    assert dot[0] < fit[0]
    assert dot[1] < fit[1]


def test_no_points_is_a_picture_too() -> None:
    svg = cross_section_svg(TREE, np.empty((0, 3), np.float32))
    assert ET.fromstring(svg).tag.endswith("svg")
    assert len(numbers(svg, "circle", "cx", "cy", "r")) == 1, "the fit alone, no points"


def target(number: int, tree_id: int = 7, **more: object) -> Target:
    made: Target = example(Target).model_copy(
        update={"stamp_ns": number * 66_000_000, "tree_id": tree_id, "range_m": 3.0 - 0.01 * number, **more}
    )
    return made


def test_lines_break_where_another_tree_is_tracked_or_none_for_a_while() -> None:
    targets = (
        [target(n) for n in range(20)] + [target(n, 8) for n in range(20, 40)] + [target(n, 8) for n in range(60, 80)]
    )
    svg = filter_plots_svg(sightings(targets))
    lines = [p.attrib["d"] for p in ET.fromstring(svg).iter("path") if p.attrib["d"].count("L") > 5]
    assert [line.count("M") for line in lines] == [3, 3, 3]


def test_frames_without_a_measurement_have_no_dot() -> None:
    targets = [target(n, raw_range_m=None, raw_radius_m=None, raw_image_x_px=None) for n in range(10)]
    assert len(re.findall(r'r="1\.6"', filter_plots_svg(sightings(targets)))) == 0


def test_the_table_of_trees_fits_the_page() -> None:
    far = TREE.model_copy(update={"id": 1234, "x_m": -123.45, "y_m": -123.45, "z_m": -12.34})
    rows = [re.findall(r"<t[hd]>(.*?)</t[hd]>", line) for line in tree_table([far]).splitlines() if "<tr>" in line]
    letters = sum(max(len(cell) for cell in column) for column in zip(*rows, strict=True))
    padding = re.search(r"th, td { padding: [\d.]+rem ([\d.]+)rem", STYLE)
    assert padding is not None
    assert 9.0 * letters + 2 * 16.0 * float(padding[1]) * len(rows[0]) <= 16.0 * (60 - 2), "9 px a letter, 16 px a rem"


@pytest.mark.parametrize("targets", [[], [target(1)], [target(n, status="lost") for n in range(9)]])
def test_nothing_tracked_gives_no_plot(targets: list[Target]) -> None:
    assert filter_plots_svg(sightings(targets)) == ""
