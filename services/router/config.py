"""Where the router listens, which is where every node connects."""

from __future__ import annotations

import ipaddress

from pydantic import BaseModel, ConfigDict, Field


class RouterConfig(BaseModel):
    """Address of the Zenoh router."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = Field(default="127.0.0.1", min_length=1, pattern=r"^[A-Za-z0-9_.:\[\]-]+$")
    """Where nodes connect: the address of the router's machine."""
    port: int = Field(default=7447, ge=1, le=65535)
    protocol: str = Field(default="tcp", pattern=r"^(tcp|tls|quic)$")
    """tls and quic need certificates (section security); quic keeps a weak radio link's latency low."""
    listen_host: str = Field(default="", pattern=r"^[A-Za-z0-9_.:\[\]-]*$")
    """Where the router itself listens when that is not ``host``: 0.0.0.0 lets other machines in."""

    shared_memory: bool = True
    """Big messages between processes of this machine go by shared memory where enough of it may be locked; off: all by
    the protocol."""

    @property
    def endpoint(self) -> str:
        """Return the address in Zenoh's writing, for example ``tcp/127.0.0.1:7447``."""
        return self._at(self.host)

    @property
    def listen_endpoint(self) -> str:
        """Return the address that the router listens on."""
        return self._at(self.listen_host or self.host)

    @property
    def local(self) -> bool:
        """Whether the bus stays on this machine: nodes connect, and the router listens, to itself alone."""
        return all(_is_local(host) for host in (self.host, self.listen_host or self.host))

    def _at(self, host: str) -> str:
        written = f"[{host}]" if ":" in host and not host.startswith("[") else host
        return f"{self.protocol}/{written}:{self.port}"


def _is_local(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
