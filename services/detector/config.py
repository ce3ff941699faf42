"""Every number the detector uses, with its unit and its reason."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class DetectorConfig(BaseModel):
    """Configuration of trunk detection by slicing."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    ground_cell_m: float = Field(default=0.5, gt=0.0)
    crop_low_m: float = 0.3
    """Height above ground where slicing begins: below it roots, grass and ground noise."""
    crop_high_m: float = 2.2
    """Height above ground where slicing ends: above it branches."""
    look_high_m: float = 4.5
    """Height above ground up to which a trunk's continuation is looked for (posts end, trees go on)."""
    voxel_m: float = Field(default=0.01, gt=0.0)
    layer_m: float = Field(default=0.10, gt=0.0)
    """Height of a slice; the reference's 2.8 cm holds 11 points of a thin trunk, this holds about 40."""
    link_m: float = Field(default=0.03, gt=0.0)
    """Cell of the connected components in a slice: gaps below one cell never split, above two always do."""

    min_radius_m: float = 0.02
    max_radius_m: float = 0.60
    """Trunks are looked for up to here; those above ``max_suitable_radius_m`` are listed as unsuitable."""
    min_suitable_radius_m: float = Field(default=0.03, ge=0.0, le=2.0)
    max_suitable_radius_m: float = Field(default=0.20, gt=0.0, le=2.0)
    max_lean_rad: float = Field(default=0.50, gt=0.0, le=1.6)
    """Steeper axes are not trunks (about 28 degrees: tolerance above the suitable 20)."""
    max_suitable_lean_rad: float = Field(default=0.349066, gt=0.0, le=1.6)
    min_slice_points: int = 6
    min_layers: int = 5
    min_span_m: float = 0.6
    """Height over which a trunk must be seen."""
    min_arc_rad: float = 0.9
    min_cover: float = 0.5
    """Share of the layers between the lowest and highest that must show the trunk."""
    suitable_fork_m: float = 1.0

    range_noise_per_m: float = 0.0020
    """Depth noise at one metre, growing with the square of range: s/(f B) = 0.08 px / (565 px * 0.070 m)."""
    surface_noise_m: float = 0.006
    """Bark, registration and quantisation: noise of a surface point whatever the range."""
    view_noise_m: float = Field(default=0.010, gt=0.0)
    """By how much, per axis, what one keyframe shows of a trunk lies beside what another shows: poses, fixed pattern."""
    out_of_round: float = Field(default=0.026, ge=0.0)
    """Share of the radius by which the side that shows differs from the whole trunk; more points do not tell."""
    off_centre: float = Field(default=0.025, ge=0.0)
    """The same for each coordinate of the axis: bark, flare and the pattern that the sensor repeats in every frame."""
    map_drift_m: float = Field(default=0.008, ge=0.0)
    """Error of the map itself per axis, as poses are slam's: no detection in that map can tell it. ``detect``: none."""
    post_top_m: float = 2.5
    """A column that ends below this height above ground, with the space above it seen empty, is no tree."""
    trials: int = Field(default=48, gt=0)
    """RANSAC trials per slice of a cluster."""
    seed: int = 1


class FusionConfig(BaseModel):
    """How much the refiner's measurements say beside the cloud."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_frames: int = Field(default=3, ge=1)
    """A view of fewer frames is not believed."""
    max_views: int = Field(default=64, ge=1)
    max_shift_m: float = Field(default=0.15, gt=0.0)
    """A view that would move the tree by more is of another tree, or of another state of the map."""
    max_radius_m: float = Field(default=0.05, gt=0.0)
    """The same for the radius."""
    common_xy_m: float = Field(default=0.010, ge=0.0)
    """Error that all views share: drift of the poses, the sensor's fixed pattern."""
    common_radius_m: float = Field(default=0.003, ge=0.0)
    cloud_xy_m: float = Field(default=0.008, gt=0.0)
    """At least this is the cloud's own error: many points do not average what they share."""
    cloud_radius_m: float = Field(default=0.003, gt=0.0)
    publish_every_s: float = Field(default=1.0, gt=0.0)
    """The list is sent no more often than this for the refiner's sake alone."""


class DetectorServiceConfig(BaseModel):
    """The detector as a service."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    slicing: DetectorConfig = DetectorConfig()
    fusion: FusionConfig = FusionConfig()
    max_rate_hz: float = Field(default=5.0, gt=0.0)
    """At most so many detections a second of the clock's time."""
    same_tree_m: float = 0.25
    """Trunks of two updates nearer than this, and of like radius, keep their id."""
    forget_after: int = Field(default=3, gt=0)
    """Updates without support after which a tree is withdrawn."""
    publish_move_m: float = 0.002
    """A tree that moved less than this, the rest the same, is no news."""
    state_dir: str = "auto"
    """Folder in which trees keep their ids when the detector is started again; ``off``; ``auto``: $STATE_DIRECTORY, else
    ~/.local/state/treedock/<uav>, and off where time is simulated."""
    await_map_s: float = Field(default=30.0, gt=0.0)
    """Started again, it waits so long for the whole of the map whose trees it knows before it makes a list of a part."""
