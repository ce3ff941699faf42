"""A whole mission on the page as a strip of pictures, made on demand: STATION_FILM=docs/station.webp pytest tests/station/test_film.py."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.station.conftest import Ground, until
from tests.station.test_page import held, true

if TYPE_CHECKING:
    from PIL import Image
    from playwright.sync_api import Page

FILM = os.environ.get("STATION_FILM", "")
STATE = "window.treedock.craft?.view?.mission?.state"
_MOST_BYTES = 1_000_000


@pytest.mark.timeout(1_200)  # made by hand, on a machine that may be busy
@pytest.mark.skipif(not FILM, reason="name a file with STATION_FILM to make the film strip")
def test_film_strip(ground: Ground, page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STUB_CAMERA", "yes")
    ground.aircraft("uav1", speed=2, seed=1)
    page.wait_for_selector("#order-start:not([aria-disabled])", timeout=90_000)
    page.wait_for_timeout(1_500)
    taken = [_taken(page)]
    _start(page)
    for name, pause_s in (("scan", 5.0), ("approach", 2.0), ("docked", 1.0)):
        true(page, f"{STATE} === '{name}'", 120.0)
        page.wait_for_timeout(pause_s * 1e3)
        if name == "approach":
            page.click(".tree-row")
            page.wait_for_timeout(500)
        taken.append(_taken(page))
    true(page, f"{STATE} === 'landed'", 120.0)
    page.click("#view-3d")
    true(page, "(window.treedock.view3d?.points ?? 0) > 299000", 60.0)
    page.wait_for_timeout(2_500)
    true(page, "window.treedock.view3d.share === 1", 60.0)
    taken.append(_taken(page))
    page.click("#view-3d")
    taken += _aborted(page)
    ground.pause("uav1", stop=True)
    page.wait_for_selector("#alarm:not([hidden])", timeout=30_000)
    page.wait_for_timeout(1_500)
    taken.append(page.screenshot())
    ground.pause("uav1", stop=False)
    assert until(lambda: page.is_hidden("#alarm"), 30.0)
    strip = _strip([_image(picture) for picture in taken], [_image(picture) for picture in _phone(page)])
    for quality in (80, 65, 50):
        strip.save(FILM, quality=quality, method=6)
        if Path(FILM).stat().st_size < _MOST_BYTES:
            return
    pytest.fail("the film strip is too big")


def _taken(page: Page) -> bytes:
    """Take a picture when nothing on it is late: a busy machine's pauses are no part of a mission."""
    old = '.vital[data-level="late"], .vital[data-level="lost"]'
    until(
        lambda: bool(page.evaluate(f"document.body.dataset.link === 'good' && !document.querySelector('{old}')")),
        20.0,
        0.02,
    )
    return page.screenshot()


def _start(page: Page) -> None:
    """Hold START until it flies: on a busy machine a page may show a state too old to command with."""

    def flies() -> bool:
        if page.evaluate(f"['idle', 'landed'].includes({STATE})"):
            held(page, "#order-start")
            page.wait_for_timeout(1_500)
        return not page.evaluate(f"['idle', 'landed'].includes({STATE})")

    assert until(flies, 120.0)


def _aborted(page: Page) -> list[bytes]:
    """Fly again and abort; the log in the dark."""
    _start(page)
    true(page, f"{STATE} === 'scan'", 120.0)
    page.click("#tab-log")
    page.click("#theme")
    held(page, "#order-abort")
    true(page, f"{STATE} === 'landing'", 60.0)
    page.wait_for_timeout(600)
    picture = _taken(page)
    true(page, f"{STATE} === 'landed'", 120.0)
    page.click("#theme")
    return [picture]


def _phone(page: Page) -> list[bytes]:
    page.set_viewport_size({"width": 390, "height": 844})
    page.click("#tab-trees")
    page.wait_for_timeout(1_500)
    pictures = [_taken(page)]
    page.click("#theme")
    page.click("#tab-systems")
    page.wait_for_timeout(800)
    return [*pictures, _taken(page)]


def _image(picture: bytes) -> Image.Image:
    from PIL import Image

    return Image.open(io.BytesIO(picture)).convert("RGB")


def _strip(wide: list[Image.Image], narrow: list[Image.Image]) -> Image.Image:
    """Two columns of the tablet's pictures, the last place for the phone's, side by side."""
    from PIL import Image

    w, h, columns = 760, 570, 2
    rows = -(-(len(wide) + 1) // columns)
    strip = Image.new("RGB", (columns * w + 20 * (columns + 1), rows * h + 20 * (rows + 1)), "white")

    def place(number: int) -> tuple[int, int]:
        return 20 + (number % columns) * (w + 20), 20 + (number // columns) * (h + 20)

    for number, picture in enumerate(wide):
        strip.paste(picture.resize((w, h)), place(number))
    x, y = place(columns * rows - 1)
    small = round(h * 390 / 844)
    for number, picture in enumerate(narrow):
        strip.paste(picture.resize((small, h)), (x + (w - 2 * small) // 3 + number * (small + (w - 2 * small) // 3), y))
    return strip
