"""Configuration of the fusion of slam with the autopilot's IMU, its GPS and a second camera. Imports nothing heavy."""

from __future__ import annotations

import math

from pydantic import BaseModel, ConfigDict, Field

from services.camera.config import CameraConfig
from services.common.config_types import Near


class ImuNoiseConfig(BaseModel):
    """What the autopilot's inertial sensors err by, as densities; vibration included."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    accel_m_s2: float = Field(default=0.03, gt=0.0)
    """White noise, per square root of Hz."""
    gyro_rad_s: float = Field(default=0.001, gt=0.0)
    accel_walk_m_s3: float = Field(default=1e-3, gt=0.0)
    """Random walk of the bias, per square root of Hz."""
    gyro_walk_rad_s2: float = Field(default=5e-5, gt=0.0)
    accel_bias_m_s2: float = Field(default=0.2, gt=0.0)
    """Standard deviation of the bias when nothing is known of it."""
    gyro_bias_rad_s: float = Field(default=0.01, gt=0.0)


class GpsConfig(BaseModel):
    """What the receiver errs by, and when it is not believed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    antenna_m: tuple[Near, Near, Near] = (0.0, 0.0, 0.0)
    """Antenna in body (forward, left, up)."""
    delay_s: float = Field(default=0.1, ge=0.0, le=1.0)
    """Age of a fix when the autopilot stamps it."""
    white_m: float = Field(default=0.5, gt=0.0)
    """Least horizontal noise from fix to fix; the receiver's own word counts where it is worse than ``slow_m``."""
    slow_m: float = Field(default=1.5, gt=0.0)
    """Standard deviation of the slow error (ionosphere, reflections), correlated over ``slow_s``."""
    slow_s: float = Field(default=100.0, gt=0.0)
    vertical_factor: float = Field(default=1.8, ge=1.0)
    """Vertical errors are so much larger."""
    begin_m: float = Field(default=6.0, gt=0.0)
    """The map's heading on earth is found once it moved so far (RMS of the way about its middle, times two)."""
    gate: float = Field(default=16.3, gt=0.0)
    """Limit of a fix's squared innovation: chi-squared of 3, one in a thousand."""
    consistent_sigmas: float = Field(default=4.0, gt=0.0)
    """Over windows of 5, 10 and 20 s the way by GPS and the way by the cameras differ by at most so much."""
    distrust_s: float = Field(default=30.0, gt=0.0)
    """A receiver that was caught is believed again after so long without another fault."""


class DriftConfig(BaseModel):
    """How odometry errs with the way, per square root of a metre: by this GPS may move the map on the earth, not more."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    shift_m: float = Field(default=0.05, gt=0.0)
    turn_rad: float = Field(default=math.radians(0.2), gt=0.0)


class SecondCameraConfig(BaseModel):
    """A second RGB-D camera that looks up or down, with a slam of its own."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = False
    offset_m: tuple[Near, Near, Near] = (0.0, 0.0, -0.05)
    """Camera centre in body (forward, left, up)."""
    pitch_rad: float = Field(default=math.pi / 2, ge=-1.6, le=1.6)
    """Down is positive: pi/2 looks at the ground, -pi/2 into the crowns; the image's upper edge is then forward, or aft."""
    yaw_rad: float = Field(default=0.0, ge=-3.2, le=3.2)
    camera: CameraConfig = CameraConfig()
    """Its source and its depth's treatment, as of the first camera."""


class FusionConfig(BaseModel):
    """Fusion: off by default. With it on, navigator and autopilot take ``fusion/pose`` instead of ``slam/pose``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = False
    imu: bool = True
    gps: bool = False
    second: SecondCameraConfig = SecondCameraConfig()
    imu_noise: ImuNoiseConfig = ImuNoiseConfig()
    gps_noise: GpsConfig = GpsConfig()
    drift: DriftConfig = DriftConfig()
    imu_hz: float = Field(default=125.0, ge=50.0, le=250.0)
    """Asked of the autopilot."""
    gps_hz: float = Field(default=5.0, ge=1.0, le=20.0)
    lag_s: float = Field(default=3.0, ge=1.0, le=20.0)
    """The smoother's window."""
    state_s: float = Field(default=0.12, ge=0.03, le=1.0)
    """Least time between two states while the first camera is located."""
    imu_alone_s: float = Field(default=1.0, ge=0.0, le=3.0)
    """Longest time for which a pose without any camera is told; it is for holding still, never for an approach."""
    second_alone_s: float = Field(default=10.0, ge=0.0, le=60.0)
    """The same while the second camera is located."""
    sigma_m: float = Field(default=0.15, gt=0.0)
    """No pose is told whose position has a larger standard deviation than this along any axis."""
    jump_m: float = Field(default=0.12, gt=0.0)
    """Slam's step and the IMU's from one state to the next differ by at most this, or five of their standard deviations."""
    jump_rad: float = Field(default=math.radians(3.0), gt=0.0)
    apart_m: float = Field(default=1.0, gt=0.0)
    """Farther apart than this nobody knows which of the two is wrong: no pose is told."""
    believe_again_s: float = Field(default=0.7, gt=0.0)
    """A place slam jumped to, and stays at for so long, is taken over with a new ``reset_counter``."""
