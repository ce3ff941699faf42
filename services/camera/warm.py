"""Compile or load every kernel of the package."""

from __future__ import annotations

from services.camera import jpeg
from services.camera.depth import pipeline
from services.common.numba_start import load_numba


def warm() -> None:
    """Compile or load every kernel of the package."""
    load_numba()
    jpeg.warm()
    pipeline.warm()
