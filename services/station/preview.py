"""The camera preview on its way to the page: checked by its message class, never decoded here. Pure."""

from __future__ import annotations


def frame_of(uav: str, jpeg: bytes) -> bytes:
    """Return the page's binary frame: ``P``, the name's length, the name, the JPEG."""
    name = uav.encode()
    return b"P" + bytes([len(name)]) + name + jpeg
