"""Configuration of the supervisor behind ``treedock run``."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class SupervisorConfig(BaseModel):
    """When a service is taken for dead or hung, and how it comes back."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    hung_after_s: float = Field(default=10.0, gt=0.0)
    """A ready service without health for this long is hung: killed and started again."""
    start_within_s: float = Field(default=240.0, gt=0.0)
    """A service must be ready by then; the first start on a machine compiles its kernels."""
    backoff_s: float = Field(default=0.5, ge=0.0)
    """Pause before a restart; doubled for each further early death, up to ``backoff_max_s``."""
    backoff_max_s: float = Field(default=10.0, ge=0.0)
    give_up_after: int = Field(default=8, ge=1)
    """A service that died so often in a row without ever becoming ready is given up, and the run ends."""
    stop_within_s: float = Field(default=2.0, gt=0.0)
    """After SIGTERM this long, SIGKILL."""
    drain_within_s: float = Field(default=30.0, ge=0.0)
    """After the source has ended, the longest wait for the services to finish what is under way."""
    mission_within_s: float = Field(default=1200.0, gt=0.0)
    """A mission that has not ended by then is broken off."""
