"""What the tracker says of one frame: the content of the Target message, without the bus."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["none", "tracking", "lost"]


@dataclass(frozen=True, slots=True)
class TargetState:
    """See ``schemas.trees.Target`` for the fields."""

    status: Status
    tree_id: int | None = None
    measured: bool = False
    bearing_rad: float | None = None
    range_m: float | None = None
    radius_m: float | None = None
    image_x_px: float | None = None
    sigma_bearing_rad: float | None = None
    sigma_range_m: float | None = None
    sigma_radius_m: float | None = None
    raw_image_x_px: float | None = None
    raw_range_m: float | None = None
    raw_radius_m: float | None = None
    position_map_m: tuple[float, float] | None = None
    covariance_map_m2: tuple[float, float, float] | None = None
    note: str = ""
