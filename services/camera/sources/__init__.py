"""Where frames come from: a TUM RGB-D folder, an MCAP recording, a ROS bag, a RealSense; the simulator's come by bus."""

from __future__ import annotations

from pathlib import Path

from services.camera.config import CameraConfig
from services.camera.sources.base import BadFrame, Source
from services.camera.sources.conditioned import ConditionedSource
from services.common.errors import InputError

__all__ = ["BadFrame", "ConditionedSource", "Source", "open_recording", "open_source"]


def open_source(spec: str, config: CameraConfig) -> ConditionedSource:
    """Open a source, watched and with the depth pipeline (``sim`` is none of this kind: it comes over the bus).

    Raises:
        InputError: another word, or the source cannot be used.
    """
    return ConditionedSource(_open(spec, config), config)


def open_recording(path: Path, config: CameraConfig) -> ConditionedSource:
    """Open a recording by what it is: a TUM folder, a ROS 2 folder, an MCAP file or a ROS bag.

    Raises:
        InputError: nothing there, or it cannot be used.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    return open_source(f"{_kind(path)}:{path}", config)


def _kind(path: Path) -> str:
    from services.camera.sources.ros_bag import is_ros

    if is_ros(path):
        return "bag"
    return "tum" if path.is_dir() else "mcap"


def _open(spec: str, config: CameraConfig) -> Source:
    kind, _, where = spec.partition(":")
    if kind == "tum" and where:
        from services.camera.sources.tum import TumSource

        return TumSource(Path(where), config)
    if kind == "mcap" and where:
        from services.camera.sources.mcap_file import McapSource

        return McapSource(Path(where), config)
    if kind == "bag" and where:
        from services.camera.sources.ros_bag import BagSource

        return BagSource(Path(where), config)
    if spec == "realsense":
        from services.camera.sources.realsense import RealsenseSource

        return RealsenseSource(config)
    raise InputError(f"camera source {spec!r}: expected sim, tum:DIR, mcap:FILE, bag:FILE or realsense")
