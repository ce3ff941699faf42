"""A whole mission on the page as a strip of pictures, made on demand: STATION_FILM=docs/station.webp pytest tests/station/test_film.py."""

from __future__ import annotations

import io
import os
import random
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.station.conftest import Ground, until
from tests.station.test_page import held, true

if TYPE_CHECKING:
    from playwright.sync_api import Page

FILM = os.environ.get("STATION_FILM", "")
STATE = "window.treedock.craft?.view?.mission?.state"
_WIDTH_PX = 1024
_MOST_BYTES = 1_000_000


@pytest.mark.skipif(not FILM, reason="name a file with STATION_FILM to make the film strip")
def test_film_strip(ground: Ground, page: Page) -> None:
    from PIL import Image

    ground.aircraft("uav1", speed=2, seed=random.Random(1).randrange(9))
    page.wait_for_selector("#order-start:not([aria-disabled])", timeout=20_000)
    pictures = [page.screenshot()]
    held(page, "#order-start")
    pictures.append(page.screenshot())
    for name, pause_s in (("scan", 5.0), ("approach", 2.0), ("docked", 1.0)):
        true(page, f"{STATE} === '{name}'", 90.0)
        page.wait_for_timeout(pause_s * 1e3)
        if name == "approach":
            page.click(".tree-row")
            page.wait_for_timeout(500)
        pictures.append(page.screenshot())
    true(page, f"{STATE} === 'landed'", 60.0)
    page.click("#tab-log")
    page.click("#theme")
    page.wait_for_timeout(800)
    pictures.append(page.screenshot())
    ground.pause("uav1", stop=True)
    page.wait_for_selector("#alarm:not([hidden])", timeout=5_000)
    page.click("#theme")
    page.wait_for_timeout(1_500)
    pictures.append(page.screenshot())
    ground.pause("uav1", stop=False)
    page.set_viewport_size({"width": 390, "height": 844})
    page.click("#tab-trees")
    assert until(lambda: page.is_hidden("#alarm"), 5.0)
    page.wait_for_timeout(800)
    phone = page.screenshot()
    wide = [Image.open(io.BytesIO(picture)) for picture in pictures]
    strip = _strip(wide, Image.open(io.BytesIO(phone)))
    for quality in (80, 65, 50):
        strip.save(FILM, quality=quality, method=6)
        if Path(FILM).stat().st_size < _MOST_BYTES:
            return
    pytest.fail("the film strip is too big")


def _strip(wide: list, phone: object):  # type: ignore[no-untyped-def]  # noqa: ANN202 - PIL has no part in the product
    """Four columns of two, the last place for the phone."""
    from PIL import Image

    w, h = 760, 570
    columns, rows = 2, 4
    strip = Image.new("RGB", (columns * w + 20 * (columns + 1), rows * h + 20 * (rows + 1)), "white")
    for number, picture in enumerate(wide[: columns * rows - 1]):
        at = (20 + (number % columns) * (w + 20), 20 + (number // columns) * (h + 20))
        strip.paste(picture.convert("RGB").resize((w, h)), at)
    last = columns * rows - 1
    small = phone.convert("RGB").resize((round(h * 390 / 844), h))  # type: ignore[attr-defined]
    at = (20 + (last % columns) * (w + 20) + (w - small.width) // 2, 20 + (last // columns) * (h + 20))
    strip.paste(small, at)
    return strip
