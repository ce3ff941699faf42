"""What the autopilot bridge says of the vehicle."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Quaternion, StampNs, Text, Vec3

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
