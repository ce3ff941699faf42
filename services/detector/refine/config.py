"""Configuration of the refiner."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class SensorNoise(BaseModel):
    """Depth noise of a stereo camera: ``sigma_z = z^2 * disparity_px / (baseline * focal)``, along the ray."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    disparity_px: float = Field(default=0.08, gt=0.0)
    baseline_m: float = Field(default=0.070, gt=0.0)
    focal_px: float = Field(default=565.0, gt=0.0)
    floor_m: float = Field(default=0.003, gt=0.0)
    """Bark, quantisation: what stays at any range."""

    @property
    def per_m(self) -> float:
        """Return ``sigma_z / z^2``, 1/m."""
        return self.disparity_px / (self.baseline_m * self.focal_px)


class SearchConfig(BaseModel):
    """Where in the depth image the trunk is looked for, and what a trunk looks like there."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_depth_m: float = Field(default=0.3, gt=0.0)
    max_depth_m: float = Field(default=6.0, gt=0.0)
    min_height_m: float = Field(default=0.35, ge=0.0)
    """Above the tree's own ground: below it lie ground, roots and grass."""
    max_height_m: float = Field(default=2.1, gt=0.0)
    gate_sigmas: float = Field(default=3.0, gt=0.0)
    min_gate_m: float = Field(default=0.20, gt=0.0)
    max_gate_m: float = Field(default=0.70, gt=0.0)
    rows: int = Field(default=48, ge=8)
    """Image rows read in the window, evenly spread."""
    max_spread_m: float = Field(default=0.5, gt=0.0)
    """Largest spread of range in one object (the reference's figure)."""
    min_rows: int = Field(default=5, ge=3)
    min_height_share: float = Field(default=0.2, gt=0.0, lt=1.0)
    """An object shorter than this share of the expected visible trunk is dropped."""


class FitConfig(BaseModel):
    """The arc fit and what is accepted from it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_points: int = Field(default=800, ge=100)
    min_points: int = Field(default=40, ge=10)
    iterations: int = Field(default=12, ge=3)
    tukey: float = Field(default=4.0, gt=1.0)
    """Residuals beyond this many sigma have no say."""
    edge_px: float = Field(default=2.0, gt=0.0)
    """Standard deviation of where an object's edge is seen, pixels; common to all rows, so rows do not average it."""
    prior_lean: float = Field(default=0.05, gt=0.0)
    """Standard deviation of the map's axis direction, rad."""
    prior_radius_m: float = Field(default=0.03, gt=0.0)
    """At least this much may the radius differ from the map's."""
    min_radius_m: float = Field(default=0.02, gt=0.0)
    max_radius_m: float = Field(default=0.30, gt=0.0)
    max_radius_change_m: float = Field(default=0.06, gt=0.0)
    max_rms: float = Field(default=2.5, gt=0.0)
    """Largest root mean square of inlier residuals, in sigmas."""
    min_inlier_share: float = Field(default=0.5, gt=0.0, lt=1.0)
    correlation: float = Field(default=4.0, ge=1.0)
    """Neighbouring depths share their noise: covariances are inflated by this."""
    systematic_m: float = Field(default=0.003, ge=0.0)
    """Added to range and radius: bumps, taper, the sensor's fixed pattern."""


class FilterConfig(BaseModel):
    """The Kalman filters of image x, range and radius."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gate: float = Field(default=5.0, gt=0.0)
    """Innovations beyond this many sigma are not believed."""
    image_x_accel_px_s2: float = Field(default=60.0, gt=0.0)
    """What the camera's known motion leaves unexplained."""
    range_accel_m_s2: float = Field(default=0.15, gt=0.0)
    white_share: float = Field(default=0.15, gt=0.0, le=1.0)
    """Share of a measurement's variance that is new in each frame: only this averages out. The rest (the sensor's
    fixed pattern, bark, edges) stays and is added to what is published. Measured in simulation."""
    pose_step_m: float = Field(default=0.003, ge=0.0)
    """Standard deviation of the pose's error from frame to frame: it enters the prediction."""
    pose_step_rad: float = Field(default=0.002, ge=0.0)
    blind_factor: float = Field(default=15.0, ge=1.0)
    """So many times larger are the accelerations while the camera's motion is not known."""
    radius_rate_m_s: float = Field(default=0.002, gt=0.0)
    lost_after_s: float = Field(default=0.5, gt=0.0, le=2.0)
    """Predictions are published as tracking for this long after the last measurement."""
    restart_after: int = Field(default=3, ge=1)
    """So many refused measurements in a row start the filters anew: then the filters are wrong, not they."""


class AgreementConfig(BaseModel):
    """When depth and colour are held to show different things."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reach_px: int = Field(default=48, ge=8)
    """So far beside the depth image's edges are the colour image's looked for: 0.1 s at 50 degrees a second."""
    widest_px: int = Field(default=6, ge=0)
    """So much may depth make a trunk wider or narrower on each side."""
    min_edges: int = Field(default=30, ge=5)
    min_contrast: float = Field(default=1.6, gt=1.0)
    """The colour edges at the best offset, over the mean of all offsets; of such frames 19 of 20 were within 4 px of the
    truth in simulation."""
    max_offset_px: float = Field(default=8.0, gt=0.0)
    moving_px_s: float = Field(default=100.0, gt=0.0)
    """Only while the trunk moves in the image by this much does a frame say something on time."""
    max_lag_s: float = Field(default=0.04, gt=0.0)
    """Streams of one camera are paired within 20 ms."""
    frames: int = Field(default=40, ge=10)
    """So many frames of the moving and of the still camera are kept; a judgement rests on ``min_frames`` at least."""
    min_frames: int = Field(default=12, ge=5)


class ConsistencyConfig(BaseModel):
    """When a tree's range is held to change with its place in the image."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_slope: float = Field(default=0.04, gt=0.0)
    """Of range over mapped range by sin or sin^2 of the bearing. Simulated: below 0.013 with the right camera, 0.06 with a
    focal length 15 % too small, 0.06 to 0.09 with one 20 % too large."""
    sigmas: float = Field(default=4.0, gt=0.0)
    passes: int = Field(default=12, ge=1)
    pass_s: float = Field(default=5.0, gt=0.0)
    """A longer pass is cut: in the time of an approach poses drift, and the drift would be taken for a slope."""
    pass_gap_s: float = Field(default=2.0, gt=0.0)
    min_frames: int = Field(default=8, ge=3)
    min_sweep_rad: float = Field(default=0.5, gt=0.0)
    """Bearings that a pass must span to say something."""
    min_total_frames: int = Field(default=20, ge=5)


class RefinerConfig(BaseModel):
    """Everything the refiner can be told."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    frames: Literal["raw", "compressed"] = "raw"
    """Which of the camera's two keys to take: ``compressed`` where the camera is on another machine."""
    noise: SensorNoise = SensorNoise()
    search: SearchConfig = SearchConfig()
    fit: FitConfig = FitConfig()
    filter: FilterConfig = FilterConfig()
    agreement: AgreementConfig = AgreementConfig()
    consistency: ConsistencyConfig = ConsistencyConfig()
    max_target_range_m: float = Field(default=6.0, gt=0.0)
    pose_wait_s: float = Field(default=0.3, gt=0.0)
    """A frame whose pose has not come by then is answered without one."""
    max_waiting_frames: int = Field(default=4, ge=1)
