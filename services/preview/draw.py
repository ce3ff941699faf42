"""Draws the overlay into a small picture, and makes a JPEG of it that is never too big."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.preview.overlay import Outline, Overlay, Pixel

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

_RED, _GREEN, _BLUE, _GREY = (40, 40, 235), (60, 220, 60), (255, 150, 60), (170, 170, 170)
_WHITE, _AMBER = (255, 255, 255), (90, 200, 255)
_LEAST_QUALITY = 15


def scaled(bgr: Image, width_px: int) -> tuple[Image, float]:
    """Return the picture no wider than ``width_px`` (never scaled up) and the factor."""
    import cv2

    factor = min(1.0, width_px / bgr.shape[1])
    if factor == 1.0:
        return bgr.copy(), 1.0
    size = (round(bgr.shape[1] * factor), round(bgr.shape[0] * factor))
    # by whole pixels of neighbours: an area filter would cost three times as much
    return np.asarray(cv2.resize(bgr, size, interpolation=cv2.INTER_LINEAR), dtype=np.uint8), factor


def draw(image: Image, overlay: Overlay, factor: float) -> None:
    """Draw into ``image`` (H, W, 3) BGR, which is ``factor`` of the size that the overlay is in."""
    for other in overlay.others:
        _outline(image, other, factor, _GREY, 1)
    if overlay.mapped is not None:
        _outline(image, overlay.mapped, factor, _BLUE, 2)
    if overlay.seen is not None:
        _outline(image, overlay.seen, factor, _GREEN, 2)
    if overlay.arrow is not None:
        _arrow(image, overlay.arrow)
    if overlay.docked:
        _frame(image, _GREEN)
    _text(image, overlay.headline, (10, 24), 0.65, _WHITE)
    _text(image, overlay.status, (10, image.shape[0] - 10), 0.5, _WHITE)
    if overlay.warning:
        _text(image, overlay.warning, (10, 48), 0.65, _AMBER)


def _points(corners: tuple[Pixel, ...], factor: float, image: Image) -> NDArray[np.int32]:
    limit = 4.0 * max(image.shape[:2])  # OpenCV wraps coordinates far outside
    return np.clip(np.array(corners) * factor, -limit, limit).round().astype(np.int32).reshape(-1, 1, 2)


def _outline(image: Image, outline: Outline, factor: float, colour: Colour, thickness: int) -> None:
    import cv2

    cv2.polylines(image, [_points(outline.corners, factor, image)], True, colour, thickness, cv2.LINE_AA)  # noqa: FBT003
    if thickness > 1:
        (u0, _), (u1, _), *_ = outline.corners
        at_top = min(v for _, v in outline.corners) * factor
        place = (round(max(u0, u1) * factor) + 4, round(np.clip(at_top + 14, 64, image.shape[0] - 40)))
        # the map's words above the depth image's
        _text(image, outline.label, (place[0], place[1] + (18 if colour == _GREEN else 0)), 0.45, colour)


def _arrow(image: Image, direction: tuple[float, float]) -> None:
    import cv2

    height, width = image.shape[:2]
    reach = 0.16 * height
    middle = np.array([0.5 * width, 0.52 * height])
    along = np.array([direction[0], -direction[1]])
    begin, end = middle - reach * along, middle + reach * along
    ends = tuple(round(v) for v in begin), tuple(round(v) for v in end)
    cv2.arrowedLine(image, *ends, _WHITE, 9, cv2.LINE_AA, tipLength=0.35)
    cv2.arrowedLine(image, *ends, _RED, 5, cv2.LINE_AA, tipLength=0.35)


def _frame(image: Image, colour: Colour) -> None:
    import cv2

    height, width = image.shape[:2]
    cv2.rectangle(image, (3, 3), (width - 4, height - 4), colour, 6)


def _text(image: Image, text: str, at: tuple[int, int], size: float, colour: Colour) -> None:
    """Write on a darkened band: readable on bark and on sky alike."""
    import cv2

    plain = text.encode("ascii", "replace").decode()
    if not plain:
        return
    (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    left = max(4, min(at[0], image.shape[1] - width - 8))
    band = image[max(0, at[1] - height - 4) : at[1] + below + 2, max(0, left - 4) : left + width + 4]
    band //= 3
    cv2.putText(image, plain, (left, at[1]), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


@dataclass(slots=True)
class Encoder:
    """JPEG within a limit of bytes: the quality follows the pictures, and one that is too big is made again."""

    max_bytes: int
    best_quality: int
    quality: int = 0

    def encode(self, image: Image) -> bytes:
        """Return the JPEG; smaller in pixels, too, where the least quality does not suffice."""
        import cv2

        self.quality = self.quality or self.best_quality
        while True:
            data = bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.quality])[1])
            if len(data) <= self.max_bytes:
                if len(data) < 0.7 * self.max_bytes:
                    self.quality = min(self.best_quality, self.quality + 2)
                return data
            if self.quality > _LEAST_QUALITY:
                self.quality = max(_LEAST_QUALITY, self.quality - 12)
            else:
                image = np.asarray(cv2.resize(image, None, fx=0.7, fy=0.7), dtype=np.uint8)
