"""Configuration of the inventory: the database, when two trees are one, and where the aircraft start."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, model_validator


class StartPoint(BaseModel):
    """Where an aircraft's map begins: its first camera position, and where the camera looks then."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    uav: str = Field(pattern=r"^([A-Za-z0-9_.-]+|\*)$", max_length=64)
    """The aircraft's name; ``*``: every aircraft without a row of its own."""
    latitude_deg: float = Field(ge=-90.0, le=90.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)
    altitude_m: float = Field(default=0.0, ge=-1_000.0, le=10_000.0)
    """Above the WGS84 ellipsoid."""
    heading_deg: float = Field(ge=-360.0, le=360.0)
    """Of the first camera view, clockwise from true north."""
    sigma_m: float = Field(default=2.0, ge=0.0)
    """Standard deviation of the position."""
    sigma_heading_deg: float = Field(default=5.0, ge=0.0)


class InventoryConfig(BaseModel):
    """The inventory's database and rules."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    database: str = ""
    """A GeoPackage file, or postgresql://...; empty: inventory.gpkg in the user's data folder; ``none``: keep nothing."""
    commit_s: float = Field(default=0.5, gt=0.0, le=10.0)
    """A power cut loses at most this and the time of one commit."""
    merge_m: float = Field(default=0.30, gt=0.0)
    """Two flights' trees farther apart than this (and than their uncertainty allows) are two trees."""
    merge_radius_m: float = Field(default=0.06, gt=0.0)
    """Trees whose radii differ by more than this (and than their uncertainty allows) are two trees."""
    align_min_trees: int = Field(default=4, ge=3)
    """A flight is laid on the inventory by the pattern of its trees when at least so many agree."""
    history_move_m: float = Field(default=0.01, ge=0.0)
    """A measurement enters the history when the tree moved by this (and half its doubt) since the last one kept..."""
    history_radius_m: float = Field(default=0.003, ge=0.0)
    """... or its radius changed by this ..."""
    history_every_s: float = Field(default=10.0, gt=0.0)
    """... or it was seen again and this time has passed."""
    start_points: tuple[StartPoint, ...] = Field(default=(), max_length=256)
    """Without one, an aircraft's trees stay in the local coordinates of its map, and say so."""

    @model_validator(mode="after")
    def _one_each(self) -> InventoryConfig:
        names = [point.uav for point in self.start_points]
        if len(set(names)) != len(names):
            raise ValueError("start_points name an aircraft twice")
        return self

    def start_of(self, uav: str) -> StartPoint | None:
        """Return the start point of an aircraft."""
        by_name = {point.uav: point for point in self.start_points}
        return by_name.get(uav) or by_name.get("*")
