"""What is looked at before an installation or a removal touches anything. Standard library only."""

from __future__ import annotations

import os
import re
import shutil
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from actions import InstallError

if TYPE_CHECKING:
    from installer import Options

MARK = "share/treedock"
"""Below the prefix: a folder that has it was made by deploy/install, and may be taken away."""
_MIN_PYTHON = (3, 11)
_HIDDEN = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
_PREFIX = re.compile(r"(/[A-Za-z0-9_+-][A-Za-z0-9._+-]*)+\Z")
"""What needs no quotes in a unit file; no . or .. leads elsewhere."""
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}\Z")


def check(verb: str, options: Options) -> None:
    """Refuse what cannot work, or would take away what is not ours, before anything is touched.

    Raises:
        InstallError: with what to do.
    """
    _check_prefix(verb, options)
    if options.live and not options.dry_run and os.geteuid() != 0:
        raise InstallError("this writes to /etc and /opt: run it with sudo, or look first with --dry-run")
    if verb == "install":
        _check_python(options)
        _check_options(options)


def _check_prefix(verb: str, options: Options) -> None:
    said = f"--prefix {options.prefix}"
    if not _PREFIX.match(options.prefix):
        raise InstallError(
            f"{said}: expected an absolute path of letters, digits and . _ + - for example /opt/treedock"
        )
    if verb == "install" and options.live and any(Path(options.prefix).is_relative_to(place) for place in _HIDDEN):
        raise InstallError(f"{said}: the services see nothing of {', '.join(_HIDDEN)}; take /opt/treedock")
    place = options.at(options.prefix)
    if place.exists() and not (place / MARK).is_dir() and not (place.is_dir() and _empty(place)):
        do = "nothing is taken away" if verb == "uninstall" else "give a folder of its own, for example /opt/treedock"
        raise InstallError(f"{said}: {place} was not made by deploy/install (no {MARK} in it): {do}")


def _empty(folder: Path) -> bool:
    return next(folder.iterdir(), None) is None


def _check_python(options: Options) -> None:
    if sys.version_info < _MIN_PYTHON:
        raise InstallError(
            f"Python {sys.version.split()[0]} is too old, 3.11 is needed: PYTHON=python3.11 deploy/install"
        )
    home = home_of(Path(sys.executable))
    if options.live and home:
        raise InstallError(
            f"this Python lies in {home}, where the services' user may not look: PYTHON=/usr/bin/python3 deploy/install"
        )
    if find_spec("ensurepip") is None:
        raise InstallError("this Python cannot make environments: apt-get install python3-venv")


def _check_options(options: Options) -> None:
    if options.live and not options.dry_run and shutil.which("systemctl") is None:
        raise InstallError("systemctl is not here: treedock runs as systemd units")
    if not _NAME.match(options.uav):
        raise InstallError(f"--uav {options.uav!r}: up to 64 letters, digits, _ and - make an aircraft's name")
    if options.uav == "station":
        raise InstallError("--uav station: certificates of that name are the ground's; give the aircraft another")
    if options.purge:
        raise InstallError("--purge goes with uninstall: deploy/install uninstall --purge")
    if options.wheels is not None and not next(options.wheels.glob("*.whl"), None):
        raise InstallError(f"--wheels {options.wheels}: no wheels there; docs/operations.md says how they are made")


def home_of(python: Path) -> str:
    """Return the home folder that a Python (or what its links lead to) lies in, empty when it is the system's."""
    for place in (python.absolute(), python.resolve()):
        for home in ("/root", "/home", "/Users"):
            if place.is_relative_to(home):
                return home
    return ""


def kept_name(config: Path, uav: str) -> str:
    """Return what to say when the administrator's file, which stays as it is, names another aircraft than was asked for."""
    try:
        kept = tomllib.loads(config.read_text()).get("uav")
    except (OSError, ValueError):  # not there yet in a dry run; what is wrong with it `treedock config` says
        return ""
    return f"{config} stays as it is and says uav = {kept!r}, not {uav!r}: change it there" if kept != uav else ""


def elsewhere(config: Path, folder: Path) -> str:
    """Return what to do where a station keeps, or kept, inventory and book in its user's ``folder``, as older ones did."""
    keys = {"inventory.gpkg": ("inventory", "database"), "fleet.json": ("fleet", "book")}
    try:
        station = tomllib.loads(config.read_text()).get("station", {})
        places = {name: station.get(table, {}).get(key, "") for name, (table, key) in keys.items()}
        kept = [name for name in keys if (folder / name).exists()]
        left = [name for name in kept if Path(places[name]).name == name and not Path(places[name]).exists()]
    except (OSError, ValueError, AttributeError):
        return ""  # not there yet in a dry run; what is wrong with it `treedock config` says
    unnamed = [f'\n      {".".join(keys[name])} = "{folder / name}"' for name in kept if not places[name]]
    if unnamed:
        do = f"add to {config}:\n      [station]{''.join(unnamed)}"
        return f"so that `sudo treedock inventory` and `fleet` find what the station keeps, {do}"
    moves = "; ".join(f"mv {folder / name}* {Path(places[name]).parent}/" for name in left)
    do = "As root, while it is stopped"
    return f"the station looks elsewhere now than in {folder}, where its files lie. {do}: {moves}" if moves else ""
