"""Configuration of the mapper."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class MapperConfig(BaseModel):
    """Dense mapping: one submap per keyframe, filtered, placed by its keyframe's pose."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_range_m: float = Field(default=0.5, gt=0.0)
    max_range_m: float = Field(default=6.0, gt=0.0)
    """Pass-through: depth outside is no data."""
    voxel_m: float = Field(default=0.01, gt=0.0)
    coarse_voxel_m: float = Field(default=0.03, gt=0.0)
    """Leaf on the ground and in the canopy, where no trunk is measured: most of the points are there."""
    fine_low_m: float = 0.25
    fine_high_m: float = 2.6
    """Heights above the lowest of the neighbourhood between which ``voxel_m`` holds."""
    ground_cell_m: float = Field(default=0.5, gt=0.0)
    range_noise_per_m: float = Field(default=0.0020, ge=0.0)
    """Depth noise at one metre, growing with the square of range."""
    edge_sigmas: float = Field(default=5.0, gt=0.0)
    edge_floor_m: float = Field(default=0.03, gt=0.0)
    """Depth steps between neighbouring pixels beyond ``edge_floor_m + edge_sigmas * noise`` are edges."""
    outlier_sigmas: float = Field(default=2.5, gt=0.0)
    """Statistical outlier removal: points whose neighbours are further than the mean by so many deviations go."""
    per_voxel: int = Field(default=1, ge=1)
    """Points of different keyframes that one voxel of the whole map takes up: bounds the map by its surface."""
    nearer: float = Field(default=0.7, gt=0.0, le=1.0)
    """A full voxel still takes a point that was seen from less than this share of the range of those in it."""
    enough_looks: int = Field(default=12, ge=1)
    """Keyframes from about the same place that looked the same way: of further ones only what is new gets in."""
    shell_sigmas: float = Field(default=2.0, ge=0.0)
    """New is then what lies further along its ray from a taken voxel than so many deviations of the range."""
    max_points: int = Field(default=3_000_000, gt=0)
    """Memory bound of the whole map (about 60 bytes a point); beyond it the oldest submaps are thinned."""
    rekey_m: float = Field(default=0.02, gt=0.0)
    """A submap that the graph moved further gives its voxels back and takes those of its new place."""
    move_m: float = Field(default=0.001, gt=0.0)
    move_rad: float = Field(default=0.0005, gt=0.0)
    """A submap that the graph moved by less is not sent again."""
    register_clouds: bool = False
    """Move each keyframe's cloud onto the local submap. Off: slam's poses are better (docs/decisions/mapper.md)."""
    registration_sigma_m: float = Field(default=0.005, gt=0.0)
    registration_sigma_rad: float = Field(default=0.001, gt=0.0)
    """How well slam places a keyframe against its neighbours: what registration may move it by."""
    registration_views: int = Field(default=64, ge=10)
    """Reduced views that are kept for it, 0.5 MB each."""
    ground_cell_model_m: float = Field(default=0.5, ge=0.1)
    """Cells of the published ground."""
    state_dir: str = "auto"
    """Folder in which the map survives a restart; ``off``; ``auto``: $STATE_DIRECTORY, else ~/.local/state/treedock/<uav>,
    and off where time is simulated."""
    save_s: float = Field(default=10.0, gt=0.0, le=1e6)
    """A changed map is written at most so often."""
