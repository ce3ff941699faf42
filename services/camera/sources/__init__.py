"""Where frames come from: a TUM RGB-D folder, an MCAP recording, a RealSense; the simulator's come over the bus."""

from __future__ import annotations

from pathlib import Path

from services.camera.config import CameraConfig
from services.camera.sources.base import BadFrame, Source
from services.common.errors import InputError

__all__ = ["BadFrame", "Source", "open_recording", "open_source"]


def open_source(spec: str, config: CameraConfig) -> Source:
    """Open ``tum:DIR``, ``mcap:FILE`` or ``realsense`` (``sim`` is no source of this kind: it comes over the bus).

    Raises:
        InputError: another word, or the source cannot be used.
    """
    kind, _, where = spec.partition(":")
    if kind == "tum" and where:
        from services.camera.sources.tum import TumSource

        return TumSource(Path(where), config)
    if kind == "mcap" and where:
        from services.camera.sources.mcap_file import McapSource

        return McapSource(Path(where), config)
    if spec == "realsense":
        from services.camera.sources.realsense import RealsenseSource

        return RealsenseSource(config)
    raise InputError(f"camera source {spec!r}: expected sim, tum:DIR, mcap:FILE or realsense")


def open_recording(path: Path, config: CameraConfig) -> Source:
    """Open a recording by what it is: a folder (TUM) or a file (MCAP).

    Raises:
        InputError: nothing there, or it cannot be used.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    return open_source(f"tum:{path}" if path.is_dir() else f"mcap:{path}", config)
