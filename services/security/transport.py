"""Zenoh settings of an encrypted bus: mutual TLS for nodes, TLS and access control for the router."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from services.common.errors import InputError
from services.security.access import access_control, radio_rules
from services.security.config import SecurityConfig
from services.security.identity import READER, STATION, Identity
from services.security.register import Register

Settings = dict[str, object]

_TLS = "transport/link/tls"


@dataclass(frozen=True, slots=True)
class Pair:
    """Files that a node shows itself by, and what it judges others by."""

    ca: Path
    certificate: Path
    key: Path


def pair_of(security: SecurityConfig, uav: str, service: str | None) -> Pair | None:
    """Return the node's files, or None on a plain bus.

    Args:
        security: the machine's settings.
        uav: the aircraft.
        service: its name; None for a tool of the command line.

    Raises:
        InputError: a file is missing or cannot be read by this user.
    """
    folder = security.folder
    if folder is None:
        return None
    identity = shown_by(security, uav, service)
    pair = Pair(folder / "ca.pem", folder / f"{identity.text}.pem", folder / f"{identity.text}.key")
    for path in (pair.ca, pair.certificate, pair.key):
        try:
            with path.open("rb"):
                pass
        except PermissionError as error:
            raise InputError(f"{path}: this user may not read it; sudo, or the services' own user, may") from error
        except OSError as error:
            raise InputError(
                f"{path}: {error.strerror}; `treedock certs issue {identity.text}` and `certs export` put it there"
            ) from error
    return pair


def shown_by(security: SecurityConfig, uav: str, service: str | None) -> Identity:
    """Return whose certificate a service shows, or a tool of the command line (None)."""
    text = f"{uav}.{service}" if service else security.identity or f"{uav}.{READER}"
    if service == STATION and security.identity.startswith(f"{STATION}."):
        text = security.identity  # a ground station of all aircraft, not one aircraft's own
    return Identity.parse(text)


def node_settings(pair: Pair | None) -> Settings:
    """Return what a client adds to its configuration."""
    if pair is None:
        return {}
    return {
        f"{_TLS}/root_ca_certificate": str(pair.ca),
        f"{_TLS}/enable_mtls": True,
        f"{_TLS}/connect_certificate": str(pair.certificate),
        f"{_TLS}/connect_private_key": str(pair.key),
        f"{_TLS}/verify_name_on_connect": True,
        f"{_TLS}/close_link_on_expiration": True,
    }


def router_settings(security: SecurityConfig, uav: str) -> Settings:
    """Return what a router adds to its configuration: nothing on a plain bus.

    Raises:
        InputError: a file is missing or damaged.
    """
    pair = pair_of(security, uav, "router")
    if pair is None or security.folder is None:
        return {}
    names = Register.read(security.folder).valid_names()
    return {
        f"{_TLS}/root_ca_certificate": str(pair.ca),
        f"{_TLS}/enable_mtls": True,
        f"{_TLS}/listen_certificate": str(pair.certificate),
        f"{_TLS}/listen_private_key": str(pair.key),
        f"{_TLS}/close_link_on_expiration": True,
        "access_control": access_control(names),
        **radio_rules(security.radio_interfaces),
    }
