"""Configuration of the ground station: where its page is served, who may see it, where the inventory lies."""

from __future__ import annotations

import ipaddress

from pydantic import BaseModel, ConfigDict, Field, model_validator

from services.fleet.config import FleetConfig
from services.inventory.config import InventoryConfig


class StationConfig(BaseModel):
    """The station's page and what it keeps."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", min_length=1, pattern=r"^[A-Za-z0-9_.:-]+$")
    """Where the page is served. Other than this machine alone needs a token or client certificates."""
    port: int = Field(default=8420, ge=0, le=65535)
    """0: any free one, told at the start."""
    token: str = Field(default="", max_length=256, pattern=r"^[A-Za-z0-9_-]*$")
    """What a browser must know on an address that others reach; empty there: one is made and told at the start."""
    tls_certificate: str = ""
    """PEM file; with ``tls_key`` the page is served by HTTPS."""
    tls_key: str = ""
    tls_client_ca: str = ""
    """PEM file of the authority whose certificates browsers must show; the token is then not asked for."""
    aircraft: tuple[str, ...] = Field(default=(), max_length=64)
    """Names of the aircraft to show; empty: all that are heard."""
    max_aircraft: int = Field(default=32, ge=1, le=256)
    """Further ones are refused and told: a stranger must not fill the memory."""
    max_browsers: int = Field(default=24, ge=1, le=256)
    page_hz: float = Field(default=5.0, gt=0.0, le=30.0)
    """How often a browser gets the state of all aircraft."""
    view_stale_s: float = Field(default=3.0, gt=0.0)
    """An order that is no stop is refused when what its browser shows is older than this."""
    keep_command_s: float = Field(default=10.0, ge=0.0)
    """An operator whose browser is gone stays in command for this long."""
    command_timeout_s: float = Field(default=2.0, gt=0.0)
    """The longest wait for the aircraft's answer; it is asked twice, for a nonce and with the command."""
    any_port: bool = False
    """Take any free port when ``port`` is in use, in place of refusing to start."""
    address_file: str = ""
    """Write the page's address into this file once it is served."""
    open_browser: bool = False
    """Open the page in this machine's browser at the start."""
    cloud: bool = True
    """Let pages see the point cloud in the 3D view: the radio carries it (``map/sketch``) while one looks, and only then."""
    inventory: InventoryConfig = InventoryConfig()
    fleet: FleetConfig = FleetConfig()
    """Which aircraft may have which tree; see docs/fleet.md."""

    @property
    def local(self) -> bool:
        """Whether only this machine reaches the page."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @model_validator(mode="after")
    def _whole(self) -> StationConfig:
        if bool(self.tls_certificate) != bool(self.tls_key):
            raise ValueError("tls_certificate and tls_key belong together: give both")
        if self.tls_client_ca and not self.tls_certificate:
            raise ValueError("tls_client_ca needs tls_certificate and tls_key")
        if self.token and len(self.token) < 16:
            raise ValueError("token must have at least 16 characters, or be empty for one that is made at the start")
        return self
