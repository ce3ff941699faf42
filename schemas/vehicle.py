"""What the autopilot bridge says of the vehicle."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Part, Quaternion, StampNs, Text, Vec3

GpsFixType = Literal["none", "2d", "3d", "differential", "rtk_float", "rtk_fixed"]
LandedState = Literal["unknown", "on_ground", "taking_off", "in_air", "landing"]


class VehicleState(Message):
    """The vehicle as its autopilot tells it, in our frames (the bridge converts NED and FRD)."""

    SCHEMA: ClassVar[str] = "treedock.vehicle"

    stamp_ns: StampNs
    seq: Counter
    connected: bool
    armed: bool
    mode: Name
    """PX4's main mode in lower case: offboard, position, hold, land, ...; unknown before the first heartbeat."""
    landed: LandedState
    quaternion_map_body: Quaternion | None
    """Attitude, body (forward, left, up) to map as the autopilot believes it."""
    position_map_m: Vec3 | None
    velocity_map_m_s: Vec3 | None
    battery_share: Annotated[float, Field(ge=0.0, le=1.0)] | None
    vision_fused: bool
    """The estimator says that it uses the vision pose."""
    operator_override: bool
    """The mode left offboard and not by our own command: the pilot has the vehicle, we are silent."""
    engaged_mission_id: Counter
    """The mission the bridge is or was last engaged for; 0 before the first."""
    link_age_s: Annotated[float, Field(ge=0.0)]
    note: Text = ""


class ImuSample(Part):
    """Means since the sample before, as the sensors gave them (bias and all)."""

    stamp_ns: StampNs
    gyro_rad_s: Vec3
    """Body (forward, left, up)."""
    accel_m_s2: Vec3
    """Specific force, body: at rest it points up."""


class ImuSamples(Message):
    """The autopilot's inertial samples since the last message, oldest first; only while fusion asks for them."""

    SCHEMA: ClassVar[str] = "treedock.imu"

    stamp_ns: StampNs
    """Of the newest sample."""
    seq: Counter
    samples: Annotated[tuple[ImuSample, ...], Field(min_length=1, max_length=100)]


class GpsFix(Message):
    """One fix of the autopilot's GPS receiver; only while fusion asks for it."""

    SCHEMA: ClassVar[str] = "treedock.gps"

    stamp_ns: StampNs
    """When the autopilot had it: the fix is older by the receiver's delay."""
    seq: Counter
    fix: GpsFixType
    satellites: Annotated[int, Field(ge=0, le=255)]
    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    altitude_m: Annotated[float, Field(ge=-1e4, le=1e5)]
    """Above mean sea level."""
    horizontal_sigma_m: Annotated[float, Field(ge=0.0, le=1e5)] | None
    """What the receiver says of its error."""
    vertical_sigma_m: Annotated[float, Field(ge=0.0, le=1e5)] | None
