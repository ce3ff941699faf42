"""Where the router listens, which is where every node connects."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class RouterConfig(BaseModel):
    """Address of the Zenoh router."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", min_length=1, pattern=r"^[A-Za-z0-9_.:\[\]-]+$")
    """Where nodes connect; a router that other machines reach listens on 0.0.0.0 there."""
    port: int = Field(default=7447, ge=1, le=65535)
    protocol: str = Field(default="tcp", pattern=r"^(tcp)$")

    @property
    def endpoint(self) -> str:
        """Return the address in Zenoh's writing, for example ``tcp/127.0.0.1:7447``."""
        host = f"[{self.host}]" if ":" in self.host and not self.host.startswith("[") else self.host
        return f"{self.protocol}/{host}:{self.port}"
