"""What the camera service can be told."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from services.camera.depth.config import DepthConfig


class RealsenseConfig(BaseModel):
    """How a RealSense D4xx is set; the defaults are for outdoors, among trees.

    They follow the vendor's tuning advice and were not measured here: there was no camera. Vegetation gives false matches,
    so the preset that asks for confidence; the projector at full power, because trunks stand in shade; exposure by the
    camera itself, because light changes as it turns.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    serial: str = ""
    """Which camera; empty: the first that is found."""
    rate_hz: Literal[6, 15, 30, 60] = 30
    preset: Literal["keep", "default", "hand", "high_accuracy", "high_density", "medium_density"] = "high_accuracy"
    """The device's own depth preset; ``keep`` leaves it as it is."""
    projector: bool = True
    laser_power_share: float = Field(default=1.0, ge=0.0, le=1.0)
    """Of the projector's largest power."""
    depth_exposure_us: float | None = Field(default=None, gt=0.0)
    """None: automatic."""
    colour_exposure_us: float | None = Field(default=None, gt=0.0)
    """None: automatic."""
    global_time: bool = True
    """Stamps by the device's clock, as the library maps it to this machine's; off: the time of arrival."""
    reopen_every_s: float = Field(default=0.5, gt=0.0, le=10.0)
    """Pause between tries after the camera was unplugged."""


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
    realsense: RealsenseConfig = RealsenseConfig()
    rate: float = Field(default=1.0, gt=0.0, le=100.0)
    """How much faster than recorded a recording is replayed."""
    restamp: bool = True
    """A live replay moves the recording's stamps to the present, so that the age of a message means something."""
    jpeg_quality: int = Field(default=90, ge=10, le=100)
    """Colour of compressed frames, on the network and in recordings."""
    compressed_depth: Literal["png", "zstd"] = "zstd"
    """Depth of compressed frames, lossless. PNG takes six to fifteen times the processor time and is no smaller
    (fr1_desk: 9.4 ms and 113 KB against 1.7 ms and 94 KB)."""

    @property
    def real(self) -> bool:
        """Whether it looks at the world now: neither simulated nor a recording."""
        return self.source == "realsense"

    @field_validator("source")
    @classmethod
    def _known(cls, source: str) -> str:
        kind, _, where = source.partition(":")
        if source not in {"sim", "realsense"} and not (kind in {"tum", "mcap", "bag"} and where):
            raise ValueError("expected sim, tum:DIR, mcap:FILE, bag:FILE or realsense")
        return source

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_range_m >= self.max_range_m:
            raise ValueError(f"min_range_m {self.min_range_m} is not below max_range_m {self.max_range_m}")
        return self
