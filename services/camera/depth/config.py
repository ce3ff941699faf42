"""Configuration of the depth pipeline; each stage can be switched off."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class DepthConfig(BaseModel):
    """Stages in their order: range, mixed pixels, bilateral, hole filling, temporal.

    All of them compare inverse depths (1/m): there stereo noise is the same at every range, ``s / (f B)``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    undistort: bool = False
    """Resample colour and depth to a camera without lens distortion. Off: slam, mapper and refiner honour the
    coefficients exactly, point by point, and lose nothing to resampling."""
    sigma_inverse: float = Field(default=0.0020, gt=0.0)
    """Noise of the inverse depth, 1/m: 0.08 px / (565 px * 0.070 m)."""
    drop_mixed: bool = True
    """On: two trees of a simulated scene 0.8 and 1.3 cm off became 0.5 and 1.4 cm, radii 3 mm better, freiburg1_desk the same
    (docs/decisions/depth-pipeline.md)."""
    bilateral: bool = False
    """Off: most stereo noise is shared by neighbours, so it gains an eighth, at the price of noise that is no longer
    independent from pixel to pixel, which is what slam, mapper and refiner take it for."""
    bilateral_diameter_px: int = Field(default=5, ge=3, le=11)
    bilateral_sigma_px: float = Field(default=1.5, gt=0.0)
    bilateral_sigmas: float = Field(default=5.0, gt=0.0)
    """Range weight's standard deviation in units of ``sigma_inverse``."""
    fill_holes: bool = False
    """Off: what it fills is made up, and the fits that follow need no closed surface."""
    fill_reach_px: int = Field(default=4, ge=1, le=16)
    fill_grey_sigma: float = Field(default=12.0, gt=0.0)
    """How much the grey value may differ on one object."""
    temporal: bool = False
    """Off: it helps a camera at rest and harms one that turns."""
    temporal_share: float = Field(default=0.5, gt=0.0, lt=1.0)
    """Weight of the past; given only to pixels that did not change by more than noise."""

    @property
    def filters(self) -> bool:
        """Whether any stage beside the range changes the depth image."""
        return self.drop_mixed or self.bilateral or self.fill_holes or self.temporal
