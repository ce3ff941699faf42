"""Compile or load every kernel of the package."""

from __future__ import annotations

from services.camera import jpeg
from services.camera.depth import pipeline


def warm() -> None:
    """Compile or load every kernel of the package."""
    jpeg.warm()
    pipeline.warm()
