"""Configuration of the navigator: limits of motion, the mission's figures, and every failsafe's time limits."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from services.fleet.config import ClaimConfig

_BARK_M = 0.2
"""The largest radius that is docked at, as detector.slicing.max_suitable_radius_m by default."""


class MotionConfig(BaseModel):
    """What no setpoint may exceed. Metres, seconds, radians; heights above the ground at the start."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    max_speed_m_s: float = Field(default=0.5, gt=0.0, le=2.0)
    max_accel_m_s2: float = Field(default=0.5, gt=0.0, le=5.0)
    max_jerk_m_s3: float = Field(default=2.0, gt=0.0, le=50.0)
    max_yaw_rate_rad_s: float = Field(default=math.radians(30.0), gt=0.0, le=math.pi)
    max_yaw_accel_rad_s2: float = Field(default=math.radians(40.0), gt=0.0, le=math.tau)
    leash_m: float = Field(default=0.6, gt=0.0, le=2.0)
    """The setpoint stops running ahead when the aircraft is this far behind it."""
    fence_radius_m: float = Field(default=12.0, gt=0.0, le=200.0)
    """Geofence: horizontal distance from the start."""
    fence_height_m: float = Field(default=3.0, gt=0.0, le=50.0)
    fence_margin_m: float = Field(default=0.7, gt=0.0, le=5.0)
    """The failsafe acts when the aircraft itself is this far outside."""


class DockConfig(BaseModel):
    """What docked means (design.md section 5)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    aim_m: float = Field(default=0.95, gt=0.0, le=5.0)
    min_m: float = Field(default=0.85, gt=0.0, le=5.0)
    max_m: float = Field(default=1.00, gt=0.0, le=5.0)
    margin_m: float = Field(default=0.02, ge=0.0, le=0.5)
    """The believed mean keeps this far inside both limits, so that the true one is inside too."""
    prefer_m: float = Field(default=0.015, gt=0.0, le=0.5)
    """For the first ``prefer_s`` in dock only a mean this near to the aim counts: patience buys accuracy."""
    prefer_s: float = Field(default=12.0, ge=0.0, le=300.0)
    bearing_rad: float = Field(default=math.radians(3.0), gt=0.0, le=0.5)
    window_s: float = Field(default=3.0, gt=0.0, le=60.0)
    still_m: float = Field(default=0.12, gt=0.0, le=1.0)
    """Not moving: how far the camera may wander within the window."""
    drift_m_s: float = Field(default=0.05, gt=0.0, le=0.5)
    """Not moving: the slope of the camera's position over the window."""
    enter_m: float = Field(default=1.15, gt=0.0, le=10.0)
    """Approach ends and dock begins at this distance."""
    leave_m: float = Field(default=1.5, gt=0.0, le=10.0)
    """Dock falls back to approach beyond this distance."""
    integral_per_s: float = Field(default=0.25, ge=0.0, le=10.0)
    """How fast a standing offset between setpoint and camera is learnt and taken out; 0 switches it off."""
    integral_limit_m: float = Field(default=0.20, ge=0.0, le=1.0)
    stiffness: float = Field(default=0.5, ge=0.0, le=1.0)
    """How much firmer than the autopilot alone the place is held: its own gain is 1. In gusts of 0.6 m/s the true
    place strays 0.11 m RMS with 0, 0.06 m with 0.5 and 0.05 m with 0.8, where less margin is left."""
    timeout_s: float = Field(default=60.0, gt=0.0, le=3600.0)
    hold_s: float = Field(default=4.0, ge=0.0, le=3600.0)
    """Hover after docking before what follows."""

    @model_validator(mode="after")
    def _ordered(self) -> DockConfig:
        if not self.min_m < self.aim_m < self.max_m < self.enter_m < self.leave_m:
            raise ValueError("dock distances must rise: min_m < aim_m < max_m < enter_m < leave_m")
        if not self.min_m + self.margin_m < self.aim_m < self.max_m - self.margin_m:
            raise ValueError("dock.aim_m must lie within min_m + margin_m .. max_m - margin_m")
        return self


class FailsafeConfig(BaseModel):
    """Time limits: ``*_s`` until the failsafe acts, ``*_hold_s`` in hold before landing.

    Bounded above: milliseconds, or infinity, would switch a failsafe off without a word.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    pose_silent_s: float = Field(default=0.4, gt=0.0, le=5.0)
    pose_late_s: float = Field(default=0.7, gt=0.0, le=5.0)
    """A pose whose image was taken longer ago than this is of where the aircraft was."""
    pose_land_s: float = Field(default=0.9, gt=0.0, le=5.0)
    """Without a pose for this long we land. PX4 gives up its position 1 s after the last vision (EKF2_NOAID_TOUT) and
    0.2 s of its own delay; until then it still lands on our word, and lands better: on its position as long as it can."""
    pose_carried_s: float = Field(default=0.3, ge=0.0, le=2.0)
    """So much longer when slam fell silent without a word: as long as the bridge carries its last pose on
    (autopilot.propagate_s)."""
    pose_hold_s: float = Field(default=3.0, gt=0.0, le=60.0)
    """After a jump: in hold until the poses agree with each other again, or landing."""
    pose_jump_m: float = Field(default=0.4, gt=0.0, le=5.0)
    pose_jump_rad: float = Field(default=math.radians(15.0), gt=0.0, le=math.pi)
    correction_hold_m: float = Field(default=1.0, gt=0.0, le=10.0)
    """A told correction larger than this is held upon like a jump."""
    target_lost_s: float = Field(default=0.45, gt=0.0, le=5.0)
    target_hold_s: float = Field(default=10.0, gt=0.0, le=300.0)
    trees_stale_s: float = Field(default=120.0, gt=0.0, le=3600.0)
    trees_hold_s: float = Field(default=15.0, gt=0.0, le=300.0)
    service_silent_s: float = Field(default=3.5, gt=0.0, le=30.0)
    service_hold_s: float = Field(default=20.0, gt=0.0, le=300.0)
    vehicle_silent_s: float = Field(default=0.5, gt=0.0, le=5.0)
    vehicle_hold_s: float = Field(default=5.0, gt=0.0, le=60.0)
    ground_silent_s: float = Field(default=5.0, gt=0.0, le=60.0)
    ground_hold_s: float = Field(default=30.0, gt=0.0, le=600.0)
    battery_start_share: float = Field(default=0.40, ge=0.0, le=1.0)
    battery_land_share: float = Field(default=0.20, ge=0.0, le=1.0)
    battery_next_share: float = Field(default=0.30, ge=0.0, le=1.0)
    """Below this no further tree is begun: return and land."""
    battery_silent_s: float = Field(default=10.0, gt=0.0, le=300.0)
    """A battery that was known in this flight and is not told any more for so long counts as one below that."""
    view_silent_s: float = Field(default=0.5, gt=0.0, le=5.0)
    """The live guard is blind when no depth image came for so long: nothing is flown at that it has not looked at."""
    obstacle_hold_s: float = Field(default=10.0, gt=0.0, le=300.0)
    restart_hold_s: float = Field(default=5.0, gt=0.0, le=60.0)
    operator_hold_s: float = Field(default=180.0, gt=0.0, le=3600.0)
    clear_s: float = Field(default=1.0, ge=0.0, le=30.0)
    """A fault must be gone for this long before the mission goes on."""


class NavigatorConfig(BaseModel):
    """The mission and its limits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    motion: MotionConfig = MotionConfig()
    dock: DockConfig = DockConfig()
    failsafe: FailsafeConfig = FailsafeConfig()
    claims: ClaimConfig = ClaimConfig()
    """Of trees among several aircraft; see docs/fleet.md."""
    handheld: bool = False
    """A person carries the camera: guidance is shown, no vehicle is asked or commanded."""
    trees_wanted: int = Field(default=1, ge=1, le=100)
    return_home: bool = False
    """Fly back to the start before landing; always done after more than one tree."""
    rate_hz: float = Field(default=20.0, ge=5.0, le=100.0)
    start_height_m: float = Field(default=0.1, ge=0.0, le=3.0)
    """Camera above ground at the start (the map's origin)."""
    flight_height_m: float = Field(default=1.5, gt=0.0, le=50.0)
    min_ground_m: float = Field(default=1.0, gt=0.0, le=20.0)
    """Least height over the known ground, at the target's foot and below the aircraft: it rises on a slope."""
    climb_speed_m_s: float = Field(default=0.4, gt=0.0, le=2.0)
    scan_rate_rad_s: float = Field(default=math.radians(25.0), gt=0.0, le=math.pi)
    scan_overlap_rad: float = Field(default=math.radians(20.0), ge=0.0, le=3.2)
    scan_falter_inliers: int = Field(default=40, ge=0, le=10000)
    """With fewer matched points than this slam falters: the scan turns back and comes again slowly."""
    scan_turns_max: float = Field(default=2.2, ge=1.0, le=20.0)
    turn_rate_rad_s: float = Field(default=math.radians(25.0), gt=0.0, le=math.pi)
    approach_speed_m_s: float = Field(default=0.35, gt=0.0, le=2.0)
    approach_gain_per_s: float = Field(default=0.5, gt=0.0, le=5.0)
    """Speed per metre still to go: the closer, the slower."""
    visual_range_m: float = Field(default=4.0, gt=0.0, le=30.0)
    """Within this distance of the trunk the approach needs the target in sight; beyond it the map will do."""
    select_settle_s: float = Field(default=2.0, ge=0.0, le=120.0)
    select_wait_s: float = Field(default=15.0, gt=0.0, le=600.0)
    select_confidence: float = Field(default=0.3, ge=0.0, le=1.0)
    face_wait_s: float = Field(default=10.0, gt=0.0, le=600.0)
    target_timeout_s: float = Field(default=150.0, gt=0.0, le=3600.0)
    """Longest time from choosing a tree to docking at it; in the approach, then the next tree is chosen."""
    look_s: float = Field(default=3.0, gt=0.0, le=120.0)
    """How long to look along a way that nobody has seen, before the tree is given up."""
    undock_m: float = Field(default=1.8, gt=0.0, le=20.0)
    """Distance from the trunk's axis at which undocking ends."""
    aircraft_radius_m: float = Field(default=0.35, gt=0.0, le=3.0)
    safety_radius_m: float = Field(default=0.80, gt=0.0, le=5.0)
    live_guard: bool = True
    """Brake for whatever the depth image shows in the way, mapped or not, and fly only where somebody has looked."""
    frames: Literal["raw", "compressed"] = "raw"
    """Which of the camera's two keys the guard takes: ``compressed`` where the camera is on another machine."""
    guard_height_m: float = Field(default=0.25, gt=0.0, le=2.0)
    """Half height of the aircraft with margin, for the live guard."""
    preflight_wait_s: float = Field(default=60.0, gt=0.0, le=3600.0)
    """PX4 takes 5 to 20 s to use the vision pose, and longer when it is still starting."""
    arm_wait_s: float = Field(default=40.0, gt=0.0, le=600.0)
    """More than the bridge spends on mode and arming (autopilot.engage_timeout_s each): it knows the reason."""
    takeoff_wait_s: float = Field(default=30.0, gt=0.0, le=600.0)
    nonce_valid_s: float = Field(default=10.0, gt=0.0, le=60.0)
    ground_required: bool = False
    """Refuse to start without a ground station; a lost one is acted upon either way once it was there."""

    @model_validator(mode="after")
    def _fits(self) -> NavigatorConfig:
        """Refuse what cannot be flown, or only into something."""
        if self.aircraft_radius_m > self.safety_radius_m:
            raise ValueError(
                f"aircraft_radius_m {self.aircraft_radius_m:g} is larger than safety_radius_m {self.safety_radius_m:g}: ways are planned "
                "with the latter"
            )
        nearest_m = self.aircraft_radius_m + _BARK_M
        if self.dock.min_m < nearest_m:
            raise ValueError(
                f"dock.min_m {self.dock.min_m:g} is nearer to a trunk's axis than aircraft_radius_m {self.aircraft_radius_m:g} and the "
                f"radius of a trunk ({_BARK_M:g}) allow: {nearest_m:g} at least"
            )
        if not self.handheld and self.flight_height_m >= self.motion.fence_height_m:
            raise ValueError(
                f"flight_height_m {self.flight_height_m:g} is not below motion.fence_height_m {self.motion.fence_height_m:g}: raise the fence"
            )
        if not self.handheld and self.start_height_m >= self.flight_height_m:
            raise ValueError(
                f"start_height_m {self.start_height_m:g} is not below flight_height_m {self.flight_height_m:g}: it is the camera's height "
                "above the ground before take-off"
            )
        return self
