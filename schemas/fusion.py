"""What fusion says of itself beside the pose: what carries it, how the GPS stands, where the map lies on the earth."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Part, StampNs, Text, Vec3

Carrier = Literal["camera", "second", "imu", "none"]
GpsTrust = Literal["off", "waiting", "trusted", "distrusted", "silent"]


class EarthPlace(Part):
    """The aircraft on the earth, by camera, IMU and GPS together."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    altitude_m: Annotated[float, Field(ge=-1e4, le=1e5)]
    heading_rad: Annotated[float, Field(ge=-math.pi, le=math.pi)]
    """Of the body's forward axis, from north, positive to the east."""
    sigma_m: Annotated[float, Field(ge=0.0, le=1e6)]
    """Horizontal standard deviation along one axis."""


class FusionState(Message):
    """Fusion's account of itself, twice a second."""

    SCHEMA: ClassVar[str] = "treedock.fusion"

    stamp_ns: StampNs
    seq: Counter
    map_id: Name | None
    carrier: Carrier
    """What the last told pose stands by."""
    carried_s: Annotated[float, Field(ge=0.0, le=1e6)]
    """Since the first camera was last located."""
    gps: GpsTrust
    gps_word: Text
    """Why the receiver is not believed."""
    place: EarthPlace | None
    """Absent until the way was long enough to know the map's heading."""
    accel_bias_m_s2: Vec3
    gyro_bias_rad_s: Vec3
    restarts: Counter
    jumps_announced: Counter
    """Jumps that slam did not tell and fusion did."""
