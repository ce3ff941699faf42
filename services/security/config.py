"""Where a node's certificate lies; without one the bus is plain and open to everybody on the machine."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field


class SecurityConfig(BaseModel):
    """Certificates of this machine's nodes, made by ``treedock certs``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    folder: Path | None = None
    """Folder with ``ca.pem``, ``identities.json``, and ``{identity}.pem`` and ``.key`` of the nodes that run here."""
    identity: str = Field(default="", pattern=r"^([A-Za-z0-9_-]+\.[A-Za-z0-9_.-]+)?$", max_length=64)
    """Whose certificate is shown; empty: a service shows ``{uav}.{service}``, a tool of the command line ``{uav}.reader``."""
    radio_interfaces: tuple[str, ...] = ()
    """Network interfaces of the router behind which the radio lies: keys are thinned and held small there, and
    what is to stay aboard does not pass."""
