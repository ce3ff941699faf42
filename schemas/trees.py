"""Trees: the list from the map and the one target from the depth image."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from schemas.envelope import Counter, Message, Name, Part, StampNs, Text, TreeId, Vec3

NonNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]

MIN_SUITABLE_RADIUS_M = 0.03
MAX_SUITABLE_RADIUS_M = 0.20
MAX_SUITABLE_LEAN_RAD = math.radians(20.0)


class Tree(Part):
    """One trunk. ``x_m, y_m, z_m`` is where its axis meets the local ground."""

    id: TreeId
    x_m: float
    y_m: float
    z_m: float
    axis: Vec3
    """Unit vector along the trunk, upward."""
    radius_m: NonNegative
    radius_height_m: NonNegative
    """Height above ground at which ``radius_m`` holds: 1.3 (breast height), else the nearest seen."""
    height_seen_m: NonNegative
    sigma_xy_m: NonNegative
    sigma_radius_m: NonNegative
    arc_rad: Annotated[float, Field(ge=0.0, le=2.0 * math.pi + 1e-9)]
    confidence: Share
    observations: Annotated[int, Field(ge=0)]
    suitable: bool
    """Radius 0.03..0.20 m, no fork below 1 m, lean at most 20 degrees."""

    @field_validator("axis")
    @classmethod
    def _unit_upward(cls, value: Vec3) -> Vec3:
        norm = math.sqrt(sum(c * c for c in value))
        if abs(norm - 1.0) > 1e-6:
            raise ValueError(f"axis of length {norm:.9f}, expected 1 within 1e-6")
        return value


class TreeList(Message):
    """All trees known in one map; replaces every earlier version of the same ``map_id``."""

    SCHEMA: ClassVar[str] = "treedock.trees"
    MAX_BYTES: ClassVar[int] = 4 * 1024 * 1024

    stamp_ns: StampNs
    map_id: Name
    version: Counter
    graph_version: Counter
    trees: Annotated[tuple[Tree, ...], Field(max_length=20_000)]


class Target(Message):
    """The target tree as the depth image shows it in one frame; sent for every frame, seen or not."""

    SCHEMA: ClassVar[str] = "treedock.target"

    stamp_ns: StampNs
    seq: Counter
    map_id: Name
    status: Literal["none", "tracking", "lost"]
    """none: no tree is expected in view; tracking: measured or predicted for a few frames; lost: expected, not seen."""
    tree_id: TreeId | None
    measured: bool
    """True when this very frame showed the trunk, false when the values below are predictions."""
    bearing_rad: float | None
    """Horizontal angle of the trunk's axis from the camera's forward direction, positive to the left."""
    range_m: NonNegative | None
    """Horizontal distance from the camera to the trunk's axis."""
    radius_m: NonNegative | None
    image_x_px: float | None
    sigma_bearing_rad: NonNegative | None
    sigma_range_m: NonNegative | None
    sigma_radius_m: NonNegative | None
    raw_image_x_px: float | None
    raw_range_m: NonNegative | None
    raw_radius_m: NonNegative | None
    position_map_m: tuple[float, float] | None
    """The trunk's axis in map, x and y, at the camera's height."""
    covariance_map_m2: tuple[float, float, float] | None
    """xx, xy, yy of ``position_map_m``."""
    note: Text = ""
