"""The one configuration tree: defaults < /etc/treedock/*.toml < --config < TREEDOCK_* < flags."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class TreedockConfig(BaseModel):
    """Configuration of the whole system; one field per service."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    uav: str = "uav1"
