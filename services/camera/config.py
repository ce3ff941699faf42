"""What the camera service can be told."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from services.camera.depth.config import DepthConfig


class CameraConfig(BaseModel):
    """Source, range filter and wire formats of the camera service."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str = "sim"
    """``sim``, ``tum:DIR``, ``mcap:FILE``, ``bag:FILE`` (ROS 1 or 2) or ``realsense``."""
    camera_file: str = ""
    """Intrinsics to use in place of the source's own (TUM folders, ROS bags, RealSense): what calibrate wrote."""
    min_range_m: float = Field(default=0.5, ge=0.0)
    """Depth nearer than this is no data; the R200 is blind below 0.5 m, other sensors may see nearer."""
    max_range_m: float = Field(default=6.0, gt=0.0)
    depth: DepthConfig = DepthConfig()
    """The depth pipeline's stages."""
    depth_camera_file: str = ""
    """Calibration of a depth camera of its own (camera.json with ``T_colour_depth``): depth is then registered to colour
    with it. Empty: the source's depth is registered already."""
    stall_s: float = Field(default=1.0, gt=0.0)
    """No frame for so long is a stall."""
    associate_within_s: float = Field(default=0.020, gt=0.0, le=1.0)
    """Largest time between a colour and a depth image of one frame (TUM folders without associations.txt)."""
    bag_colour_topic: str = ""
    """Colour images in a ROS bag; empty: the likeliest."""
    bag_depth_topic: str = ""
    """Depth images in a ROS bag; empty: the likeliest, registered ones first."""
    rate: float = Field(default=1.0, gt=0.0, le=100.0)
    """How much faster than recorded a recording is replayed."""
    restamp: bool = True
    """A live replay moves the recording's stamps to the present, so that the age of a message means something."""
    jpeg_quality: int = Field(default=90, ge=10, le=100)
    compressed_depth: Literal["png", "zstd"] = "png"

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} is not below max_range_m {self.max_range_m}")
        return self
