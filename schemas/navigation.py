"""What the navigator says: the mission's state and the one thing the vehicle should do now."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from schemas.envelope import Counter, Message, Name, Part, StampNs, Text, TreeId, Vec3

GuidanceCommand = Literal["take_off", "landing", "turn_left", "turn_right", "toward", "backward", "stop", "docked"]
"""The reference's eight commands."""

MissionStateName = Literal[
    "idle", "preflight", "take_off", "scan", "select", "face", "approach", "dock", "docked", "undock",
    "return", "landing", "landed", "hold", "released", "failed",
]  # fmt: skip


class Setpoint(Part):
    """Where the vehicle's camera should be in ``map`` and how it should move there."""

    position_m: Vec3
    yaw_rad: Annotated[float, Field(ge=-math.pi - 1e-9, le=math.pi + 1e-9)]
    """Heading of the camera about map's z, 0 along x, positive to the left."""
    velocity_m_s: Vec3
    yaw_rate_rad_s: float


class Guidance(Message):
    """One of the eight commands with its magnitude, and the setpoint that carries it out."""

    SCHEMA: ClassVar[str] = "treedock.guidance"

    stamp_ns: StampNs
    seq: Counter
    map_id: Name
    command: GuidanceCommand
    magnitude: Annotated[float, Field(ge=0.0)]
    unit: Literal["m", "rad", ""]
    engage: bool
    """True only while the mission wants the vehicle in offboard mode and armed."""
    land: bool
    """True when the vehicle is to come down where it is."""
    mission_id: Counter
    """Up by one for each accepted start command: what the bridge may engage once, and no more."""
    reset_counter: Annotated[int, Field(ge=0, le=255)]
    """Of the pose that the setpoint was made from."""
    setpoint: Setpoint | None
    reason: Text = ""


class MissionState(Message):
    """The state machine's state, and the event that led to it."""

    SCHEMA: ClassVar[str] = "treedock.mission"

    stamp_ns: StampNs
    seq: Counter
    map_id: Name
    state: MissionStateName
    previous: MissionStateName
    since_ns: StampNs
    reason: Text
    """Why this state was entered, in words for the operator."""
    target_tree_id: TreeId | None
    visited_tree_ids: Annotated[tuple[TreeId, ...], Field(max_length=1_000)]
    docked_count: Counter
    distance_m: Annotated[float, Field(ge=0.0)] | None
    """Believed horizontal distance from the camera to the target's axis."""
    heading_error_rad: float | None
    failsafe: Text = ""
    """The name of the failsafe in force, empty when none is."""
