"""The camera preview on its way to the page: checked for what it is, never decoded. Pure."""

from __future__ import annotations

MAX_BYTES = 64 * 1024


def jpeg_fault(data: bytes) -> str:
    """Return what keeps ``data`` from being one whole JPEG of acceptable size, empty when it is one."""
    if len(data) > MAX_BYTES:
        return f"{len(data)} bytes, at most {MAX_BYTES} are accepted"
    if not (data.startswith(b"\xff\xd8\xff") and data.rstrip(b"\0").endswith(b"\xff\xd9")):
        return "not a whole JPEG"
    return ""


def frame_of(uav: str, jpeg: bytes) -> bytes:
    """Return the page's binary frame: ``P``, the name's length, the name, the JPEG."""
    name = uav.encode()
    return b"P" + bytes([len(name)]) + name + jpeg
