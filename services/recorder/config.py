"""What is recorded, where to, and what happens when the disk is slow or full."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class RecorderConfig(BaseModel):
    """Settings of the recorder."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: Path = Path("recordings")
    """Where the files lie, one or more a run; a unit sets it to its state directory."""
    mcap: bool = True
    """False: nothing is recorded, only the missions' reports are written."""
    frames: Literal["compressed", "raw", "off"] = "compressed"
    """Camera frames: colour as JPEG and depth lossless (``camera.jpeg_quality`` and ``camera.compressed_depth`` say how),
    as the sensor gave them (23 MB/s at 15 Hz), or none."""
    foxglove: bool = True
    """Also write image, cloud, pose and scene under Foxglove's schemas, so that Foxglove shows the file as it is."""
    foxglove_image_hz: float = Field(default=5.0, gt=0.0, le=60.0)
    flush_s: float = Field(default=0.5, gt=0.0, le=10.0)
    """A power cut or a kill loses at most so much, and what the disk itself had not yet done."""
    file_mb: int = Field(default=2000, ge=1)
    """A file that reaches this is closed and the next one begun."""
    queue_mb: int = Field(default=64, ge=1)
    """What waits for a slow disk; beyond it frames are dropped and counted, then everything."""
    reserve_mb: int = Field(default=500, ge=0)
    """Free disk space that is left alone: below it no frames are written, below a quarter of it nothing."""
