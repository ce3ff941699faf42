"""Configuration of the finer map that ``treedock process --fine`` makes after the flight."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class FineConfig(BaseModel):
    """All frames fused at finer resolution, and every stem measured along its height."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    voxel_m: float = Field(default=0.005, gt=0.0)
    """Leaf of the fine cloud around stems."""
    coarse_voxel_m: float = Field(default=0.02, gt=0.0)
    """Leaf elsewhere."""
    reach_m: float = Field(default=0.5, gt=0.0)
    """So far around a stem's surface the leaf is fine, and points are kept to measure it."""
    max_range_m: float = Field(default=6.0, gt=0.0)
    range_noise_per_m: float = Field(default=0.0020, gt=0.0)
    """Depth noise at one metre, growing with the square of range."""
    surface_noise_m: float = Field(default=0.006, gt=0.0)
    """Bark, pose and registration: noise of a surface point whatever the range."""
    least_observations: int = Field(default=3, ge=1)
    """Pixels that must have seen a place of the fine cloud; elsewhere two thirds of that."""
    max_voxels: int = Field(default=12_000_000, gt=0)
    """Memory bound, about 80 bytes each; beyond it new places are left out and counted."""
    max_stem_points: int = Field(default=400_000, ge=1000)
    """Per stem; beyond it every second one is kept."""

    step_m: float = Field(default=0.1, gt=0.0)
    """A diameter every so much of height, from a section as high."""
    low_m: float = Field(default=0.2, ge=0.0)
    """Height above ground of the lowest section."""
    flare_m: float = Field(default=0.4, ge=0.0)
    """Below this roots widen the stem; the taper function is fitted above."""
    blocks: int = Field(default=8, ge=3)
    """Parts of the recording that are left out in turn to tell how sure a diameter is (delete-a-group jackknife)."""
    full_keyframes: int = Field(default=500, ge=10)
    """Keyframes that are adjusted together before fusing; larger maps are adjusted in parts of so many."""
    out_of_round: float = Field(default=0.02, ge=0.0)
    """Share of the diameter by which the side that shows differs from the whole stem, for a half that shows."""
    ground_cell_m: float = Field(default=0.25, gt=0.0)
    """Cells of the ground model."""
    crown_reach_m: float = Field(default=2.0, ge=0.0)
    """How far from its stem a connected part of the cloud still belongs to a tree."""
