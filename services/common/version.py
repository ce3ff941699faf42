"""Which treedock runs here: the release, and a fingerprint of messages and keys that both ends of the bus must share."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import schemas


@cache
def running_version() -> str:
    """Return for example ``0.1.0+3fa9c1d2``; two that differ after the ``+`` may refuse each other's messages."""
    try:
        release = version("treedock")
    except PackageNotFoundError:  # a checkout that was never installed
        release = "0"
    return f"{release}+{_contract()}"


def same_contract(one: str, other: str) -> bool:
    """Whether two versions speak the same messages; a newer release may."""
    return one.rpartition("+")[2] == other.rpartition("+")[2]


def _contract() -> str:
    """Return a hash over the files that say what is on the bus."""
    digest = hashlib.sha256()
    for path in sorted(Path(schemas.__path__[0]).glob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:8]
