"""Configuration of the slam service."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SlamConfig(BaseModel):
    """Everything about slam that may be set; lengths in metres, image lengths in pixels of the full size image."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: Literal["raw", "compressed"] = "raw"
    """Which of the camera's two keys to take: ``compressed`` where the camera is on another machine."""
    features: int = Field(default=1000, ge=100, le=4000)
    """Features kept per frame."""
    levels: int = Field(default=8, ge=1, le=12)
    scale: float = Field(default=1.2, gt=1.0, le=2.0)
    fast_threshold: int = Field(default=19, ge=5, le=60)
    fast_threshold_low: int = Field(default=7, ge=2, le=60)
    """Where texture is poor."""
    min_depth_m: float = Field(default=0.3, gt=0)
    max_depth_m: float = Field(default=8.0, gt=0)
    """Depth beyond this makes no map point: the sensor's range."""
    far_m: float = Field(default=16.0, gt=0)
    """Distance at which a feature is begun that has no depth and none around it: beyond the sensor's range. Its inverse is then
    anywhere between none and one over 8 m: this is the middle, and the next its standard deviation."""
    far_sigma_inverse_m: float = Field(default=0.02, gt=0)
    """Standard deviation of the inverse of that distance, 1/m. Both are learned anew once parallax has told enough distances."""
    baseline_m: float = Field(default=0.08, gt=0)
    """Virtual stereo baseline: depth enters as the disparity ``fx * baseline / z``, whose noise is constant."""
    disparity_sigma_px: float = Field(default=0.6, gt=0)
    """Noise of that disparity."""
    min_inliers: int = Field(default=25, ge=6)
    """Fewer matches of the map than this: lost."""
    keyframe_ratio: float = Field(default=0.85, gt=0, le=1)
    """A new keyframe when the inliers fall below this share of the most since the last one."""
    close_tracked_min: int = Field(default=100, ge=0)
    close_untracked_max: int = Field(default=70, ge=0)
    """A keyframe at once when fewer close points are tracked and more are not."""
    window_keyframes: int = Field(default=12, ge=2)
    """Keyframes that a local bundle adjustment moves."""
    full_keyframes: int = Field(default=150, ge=10)
    """A map of more is adjusted in parts of so many keyframes."""
    loop_closing: bool = True
    relocalise: bool = True
    new_map_after_s: float = Field(default=30.0, gt=0)
    """Lost for so long (live), a new map is begun, under a new ``map_id``."""
    keep_map: bool = True
    """Live, keyframes are kept on disk as they are made; a slam that was killed goes on with its map."""
    map_folder: Path | None = None
    """Where; by default in the state directory of the service or of the user."""
    map_max_age_s: float = Field(default=600.0, gt=0, le=3e7)
    """A map whose slam lived longer ago than this is not taken up, nor one from before the machine's last start."""
    map_file_mb: float = Field(default=256.0, gt=1)
    """Limit of the file of keyframes (54 KB each)."""
    relocalise_within_s: float = Field(default=10.0, gt=0)
    """A map that was taken up, and in which no frame is located for so long, is given up for a new one."""
