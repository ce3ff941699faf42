"""How big, how often and how good the preview is."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class PreviewConfig(BaseModel):
    """Settings of the preview."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate_hz: float = Field(default=5.0, gt=0.0, le=30.0)
    width_px: int = Field(default=480, ge=160, le=1280)
    """The picture is scaled to this width, never up."""
    max_kb: int = Field(default=60, ge=10, le=60)
    """No picture is larger; the quality follows from it."""
    best_quality: int = Field(default=80, ge=20, le=95)
