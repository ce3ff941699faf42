"""Lays treedock on a machine: a private environment, configuration, udev rules and systemd units. Idempotent.

Standard library only: it runs before anything is installed.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import units
from actions import Action, Folder, InstallError, Link, Remove, Run, Write
from checks import MARK, check, elsewhere, kept_name

SOURCE = Path(__file__).resolve().parents[1]
USER = "treedock"
UNIT_FOLDER = "etc/systemd/system"
CONFIG = "etc/treedock/10-treedock.toml"
CONFIG_OF = {"aircraft": "10-treedock.toml", "station": "station.toml"}
TARGET_OF = {"aircraft": "treedock.target", "station": "treedock-station.target"}
COMMAND = "usr/local/bin/treedock"
MEMORY_LOCK = f"{UNIT_FOLDER}/treedock-.service.d/10-memory-lock.conf"
BOOTED = Path("/run/systemd/system")
"""There while systemd runs this machine (man sd_booted)."""
STAMP = f"{MARK}/source.sha256"
"""Below the prefix: what was installed, by its bytes."""
KERNELS = f"var/cache/{USER}/numba"
HOME_DATA = f"var/lib/{USER}/.local/share/{USER}"
"""Where a station keeps what its configuration names no place for."""
RULES = "etc/udev/rules.d/60-treedock.rules"
_UAV = "uav1"
_CAP_IPC_LOCK = 1 << 14


@dataclass(frozen=True)
class Options:
    """What was asked for."""

    prefix: str
    root: Path
    uav: str
    role: str
    dry_run: bool
    wheels: Path | None
    enable: bool
    purge: bool
    no_realsense: bool
    named: bool
    """The aircraft's name was given, and is not the default."""

    def at(self, path: str) -> Path:
        """Return where a path of the installed system lies under ``--root``."""
        return self.root / path.lstrip("/")

    @property
    def live(self) -> bool:
        """Whether this is the running system and not a staging folder."""
        return self.root == Path("/")


def installation(options: Options) -> Iterator[Action]:
    """Yield what makes an installation, in order."""
    if options.live:
        yield from _libraries()
        yield from _user()
    yield from _environment(options)
    yield Folder(options.at("/etc/treedock"))
    certs = Folder(options.at("/etc/treedock/certs"), 0o700, USER if options.live else "")
    yield certs
    config = (SOURCE / "deploy/etc" / CONFIG_OF[options.role]).read_text().replace("@UAV@", options.uav)
    yield Write(options.at(CONFIG), config, keep=True)
    yield Write(options.at(RULES), (SOURCE / "deploy/udev/60-treedock.rules").read_text())
    for name, text in units.files(options.prefix).items():
        yield Write(options.at(f"{UNIT_FOLDER}/{name}"), text)
    if options.live and needs_capability():
        yield Write(options.at(MEMORY_LOCK), units.MEMORY_LOCK)
    operations = SOURCE / "docs/operations.md"
    if operations.is_file():
        yield Write(options.at(f"{options.prefix}/share/doc/treedock/operations.md"), operations.read_text())
    yield Link(options.at(COMMAND), f"{options.prefix}/bin/treedock")
    if options.live:
        yield from _activation(options)


def needs_capability(status: Path = Path("/proc/self/status")) -> bool:
    """Return whether locked memory is to be had by CAP_IPC_LOCK alone: the limit cannot be raised, as in containers."""
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except (ValueError, OSError):
        bounding = next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("CapBnd:"))
        return bool(int(bounding, 16) & _CAP_IPC_LOCK)
    return False


def _user() -> Iterator[Action]:
    known = subprocess.run(["id", USER], capture_output=True, check=False).returncode == 0
    yield Run(
        ("useradd", "--system", "--home-dir", f"/var/lib/{USER}", "--shell", "/usr/sbin/nologin", "--user-group", USER),
        "the one user of all services", needed=not known,
    )  # fmt: skip
    for folder in (f"/var/lib/{USER}", f"/var/cache/{USER}"):
        yield Folder(Path(folder), 0o750, USER)


def _libraries() -> Iterator[Action]:
    """Yield the system's libraries that the packages link against, where this is a Debian or Ubuntu."""
    if shutil.which("dpkg-query") is None:
        return
    wanted = (SOURCE / "deploy/system-packages.txt").read_text().split()
    show = ["dpkg-query", "-W", "-f=${db:Status-Status} ${Package} ${Provides}\n"]
    rows = subprocess.run(show, capture_output=True, text=True, check=False).stdout.splitlines()
    # a library may have been renamed (libidn2-0t64): what it provides counts too
    present = " ".join(row.removeprefix("installed ") for row in rows if row.startswith("installed "))
    missing = tuple(name for name in wanted if not re.search(rf"(^|[ ,]){re.escape(name)}($|[ ,])", present))
    install = ("apt-get", "install", "-y", "-qq", "--no-install-recommends", *missing)
    yield Run(install, "system libraries", needed=bool(missing))


def _environment(options: Options) -> Iterator[Action]:
    prefix = options.at(options.prefix)
    python = str(prefix / "bin/python")
    yield Folder(prefix / MARK)  # first of all: also what is left of an attempt that broke off is known as ours
    # also when the system's Python became another: what was installed for the old is lost
    new = not Path(python).exists()
    yield Run((sys.executable, "-m", "venv", str(prefix)), "a private environment", needed=new)
    offline = ("--no-index", "--find-links", str(options.wheels)) if options.wheels else ()
    stamp, wanted = prefix / STAMP, source_hash()
    changed = new or not stamp.is_file() or stamp.read_text() != wanted
    if changed:
        yield Remove(stamp)  # an attempt that is broken off is no installation
        # numba asks whether a kernel's own file changed, not those of the kernels compiled into it
        yield Remove(options.at(KERNELS))
    if options.live:
        yield Folder(options.at(KERNELS), 0o750, USER)
    yield Run(
        (python, "-m", "pip", "install", "-q", "--disable-pip-version-check", *offline, "-c",
         str(SOURCE / "constraints.txt"), str(SOURCE)),
        "treedock and its pinned packages", needed=changed,
    )  # fmt: skip
    if options.role == "aircraft" and not options.no_realsense:
        yield Run(
            (python, "-m", "pip", "install", "-q", "--disable-pip-version-check", *offline, "-c",
             str(SOURCE / "constraints.txt"), "pyrealsense2"),
            "the RealSense camera's library; where there is no wheel (ARM), build librealsense with its Python bindings",
            needed=next(prefix.glob("lib/python*/site-packages/pyrealsense2"), None) is None, may_fail=True,
        )  # fmt: skip
    yield Write(stamp, wanted)


def source_hash(source: Path = SOURCE) -> str:
    """Return a hash of all that is installed: sources, their names, and what is pinned."""
    digest = hashlib.sha256()
    files = [source / name for name in ("pyproject.toml", "constraints.txt")]
    for package in ("schemas", "services"):
        files += [path for path in (source / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    for path in sorted(files):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(source)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _activation(options: Options) -> Iterator[Action]:
    cache = f"NUMBA_CACHE_DIR=/var/cache/{USER}/numba"
    if options.role == "aircraft":
        yield Run(
            ("runuser", "-u", USER, "--", "env", cache, f"{options.prefix}/bin/treedock", "warm", "--aboard"),
            "compile the kernels once, so that services start at once",
        )
    if BOOTED.is_dir():  # not in an image that is being made: its units are read when it boots
        yield Run(("systemctl", "daemon-reload"), "read the units")
    yield Run(("udevadm", "control", "--reload"), "read the device rules", may_fail=True)
    if options.enable:
        now = ("--now",) if BOOTED.is_dir() else ()
        yield Run(("systemctl", "enable", *now, TARGET_OF[options.role]), "start now and at every boot")


def removal(options: Options) -> Iterator[Action]:
    """Yield what takes an installation away; configuration and data stay unless purged."""
    if options.live:
        for target in ("treedock.target", "treedock-station.target"):
            yield Run(("systemctl", "disable", "--now", target), "stop", may_fail=True)
        names = [name for name in units.files() if name.endswith(".service")]
        yield Run(("systemctl", "stop", *names), "stop", may_fail=True)
    for name in units.files():
        yield Remove(options.at(f"{UNIT_FOLDER}/{name}"))
    yield _without(options.at(MEMORY_LOCK))
    yield Remove(options.at(RULES))
    command = options.at(COMMAND)
    if command.is_symlink() and str(command.readlink()) == f"{options.prefix}/bin/treedock":
        yield Remove(command)
    yield Remove(options.at(options.prefix))
    if options.purge:
        for path in ("/etc/treedock", f"/var/lib/{USER}", f"/var/cache/{USER}"):
            yield Remove(options.at(path))
    if options.live:
        yield Run(("systemctl", "daemon-reload"), "forget the units", may_fail=True)


def _without(file: Path) -> Action:
    """Return what removes a file, with its folder where nothing of the administrator's lies beside it."""
    alone = file.parent.is_dir() and {path.name for path in file.parent.iterdir()} <= {file.name}
    return Remove(file.parent if alone else file)


def parse(arguments: Sequence[str]) -> tuple[str, Options]:
    """Return the verb and the options."""
    parser = argparse.ArgumentParser(prog="deploy/install", description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("verb", nargs="?", choices=("install", "uninstall"), default="install")
    parser.add_argument("--prefix", default=units.PREFIX, help="place of the private environment (default %(default)s)")
    parser.add_argument(
        "--root",
        type=Path,
        default=Path("/"),
        help="lay everything out below this folder, to look at or to test: no user is made, nothing is activated, and "
        "the environment runs from there only; for an image run the installer inside of it (chroot)",
    )
    parser.add_argument("--uav", help=f"the aircraft's name, a part of every key (default {_UAV})")
    parser.add_argument(
        "--role",
        choices=("aircraft", "station"),
        default="aircraft",
        help="what is configured, compiled and started (default %(default)s)",
    )
    parser.add_argument("--wheels", type=Path, help="folder of wheels for a machine without a network")
    parser.add_argument("--no-realsense", action="store_true", help="leave out the RealSense camera's library")
    parser.add_argument("--enable", action="store_true", help="start now and at every boot")
    parser.add_argument("--dry-run", action="store_true", help="show what would be done, do nothing")
    parser.add_argument(
        "--purge", action="store_true", help="uninstall: also configuration, certificates and recordings"
    )
    given = parser.parse_args(arguments)
    return given.verb, Options(
        given.prefix.rstrip("/") or "/",
        given.root.absolute(),
        _UAV if given.uav is None else given.uav,
        given.role,
        given.dry_run,
        given.wheels,
        given.enable,
        given.purge,
        given.no_realsense,
        given.uav is not None,
    )


def main(arguments: Sequence[str]) -> int:
    """Install or uninstall; 0 done, 2 something is to be mended first."""
    verb, options = parse(arguments)
    os.umask(0o022)  # a stricter one of root's would hide from the services' user what it is to run
    try:
        check(verb, options)
        for action in installation(options) if verb == "install" else removal(options):
            sys.stdout.write(action.describe() + "\n")
            sys.stdout.flush()
            if not options.dry_run:
                action.do()
    except (InstallError, OSError) as error:
        sys.stderr.write(f"deploy/install: {error}\n")
        return 2
    if verb == "install" and options.named and (other := kept_name(options.at(CONFIG), options.uav)):
        sys.stdout.write(f"note: {other}\n")
    if verb == "install" and (left := elsewhere(options.at(CONFIG), options.at(HOME_DATA))):
        sys.stdout.write(f"note: {left}\n")
    if verb == "install" and not options.dry_run and not options.enable and options.live:
        target = TARGET_OF[options.role]
        sys.stdout.write(f"installed; look at {options.at(CONFIG)}, then: systemctl enable --now {target}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
