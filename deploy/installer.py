"""Lays treedock on a machine: a private environment, configuration, udev rules and systemd units. Idempotent.

Standard library only: it runs before anything is installed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import units

SOURCE = Path(__file__).resolve().parents[1]
USER = "treedock"
UNIT_FOLDER = "etc/systemd/system"
CONFIG = "etc/treedock/10-treedock.toml"
RULES = "etc/udev/rules.d/60-treedock.rules"
_MIN_PYTHON = (3, 11)


class InstallError(Exception):
    """What the person at the keyboard has to mend first."""


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

    def at(self, path: str) -> Path:
        """Return where a path of the installed system lies under ``--root``."""
        return self.root / path.lstrip("/")

    @property
    def live(self) -> bool:
        """Whether this is the running system and not a staging folder."""
        return self.root == Path("/")


@dataclass(frozen=True)
class Write:
    """A file with this content."""

    path: Path
    text: str
    mode: int = 0o644
    keep: bool = False
    """Left as it is when it exists: the administrator's own."""

    def describe(self) -> str:
        """Return the line for the person who watches."""
        if self.path.exists() and self.keep:
            return f"keep    {self.path}"
        if self.path.is_file() and self.path.read_text() == self.text:
            return f"same    {self.path}"
        return f"write   {self.path}"

    def do(self) -> None:
        """Do it."""
        if not self.describe().startswith("write"):
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        fresh = self.path.with_name(self.path.name + ".new")
        fresh.write_text(self.text)
        fresh.chmod(self.mode)
        fresh.replace(self.path)


@dataclass(frozen=True)
class Folder:
    """A folder."""

    path: Path
    mode: int = 0o755
    owner: str = ""

    def describe(self) -> str:
        """Return the line for the person who watches."""
        return f"{'same   ' if self.path.is_dir() else 'make   '} {self.path}"

    def do(self) -> None:
        """Do it."""
        self.path.mkdir(parents=True, exist_ok=True)
        self.path.chmod(self.mode)
        if self.owner:
            shutil.chown(self.path, self.owner, self.owner)


@dataclass(frozen=True)
class Run:
    """A command."""

    command: tuple[str, ...]
    why: str
    needed: bool = True
    """False: skipped, because its result is there already."""
    may_fail: bool = False

    def describe(self) -> str:
        """Return the line for the person who watches."""
        return f"{'run    ' if self.needed else 'done   '} {' '.join(self.command)}   ({self.why})"

    def do(self) -> None:
        """Do it."""
        if not self.needed:
            return
        try:
            subprocess.run(self.command, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            if not self.may_fail:
                raise InstallError(
                    f"{' '.join(self.command)}: {error}; mend that and run deploy/install again"
                ) from None


@dataclass(frozen=True)
class Remove:
    """A file or folder that goes."""

    path: Path

    def describe(self) -> str:
        """Return the line for the person who watches."""
        return f"{'remove ' if self.path.exists() else 'gone   '} {self.path}"

    def do(self) -> None:
        """Do it."""
        if self.path.is_dir() and not self.path.is_symlink():
            shutil.rmtree(self.path)
        else:
            self.path.unlink(missing_ok=True)


Action = Write | Folder | Run | Remove


def installation(options: Options) -> Iterator[Action]:
    """Yield what makes an installation, in order."""
    if options.live:
        yield from _user()
    yield from _environment(options)
    yield Folder(options.at("/etc/treedock"))
    certs = Folder(options.at("/etc/treedock/certs"), 0o700, USER if options.live else "")
    yield certs
    config = (SOURCE / "deploy/etc/10-treedock.toml").read_text().replace("@UAV@", options.uav)
    yield Write(options.at(CONFIG), config, keep=True)
    yield Write(options.at(RULES), (SOURCE / "deploy/udev/60-treedock.rules").read_text())
    for name, text in units.files(options.prefix).items():
        yield Write(options.at(f"{UNIT_FOLDER}/{name}"), text)
    operations = SOURCE / "docs/operations.md"
    if operations.is_file():
        yield Write(options.at(f"{options.prefix}/share/doc/treedock/operations.md"), operations.read_text())
    if options.live:
        yield from _activation(options)


def _user() -> Iterator[Action]:
    known = subprocess.run(["id", USER], capture_output=True, check=False).returncode == 0
    yield Run(
        ("useradd", "--system", "--home-dir", f"/var/lib/{USER}", "--shell", "/usr/sbin/nologin", "--user-group", USER),
        "the one user of all services", needed=not known,
    )  # fmt: skip
    for folder in (f"/var/lib/{USER}", f"/var/cache/{USER}", f"/var/cache/{USER}/numba"):
        yield Folder(Path(folder), 0o750, USER)


def _environment(options: Options) -> Iterator[Action]:
    prefix = options.at(options.prefix)
    python = str(prefix / "bin/python")
    yield Run((sys.executable, "-m", "venv", str(prefix)), "a private environment", needed=not Path(python).exists())
    offline = ("--no-index", "--find-links", str(options.wheels)) if options.wheels else ()
    yield Run(
        (python, "-m", "pip", "install", "-q", "--disable-pip-version-check", *offline, "-c",
         str(SOURCE / "constraints.txt"), str(SOURCE)),
        "treedock and its pinned packages",
    )  # fmt: skip


def _activation(options: Options) -> Iterator[Action]:
    cache = f"NUMBA_CACHE_DIR=/var/cache/{USER}/numba"
    yield Run(
        ("runuser", "-u", USER, "--", "env", cache, f"{options.prefix}/bin/treedock", "warm"),
        "compile the kernels once, so that services start at once",
    )
    yield Run(("systemctl", "daemon-reload"), "read the units")
    yield Run(("udevadm", "control", "--reload"), "read the device rules", may_fail=True)
    target = "treedock-station.target" if options.role == "station" else "treedock.target"
    if options.enable:
        yield Run(("systemctl", "enable", "--now", target), "start now and at every boot")


def removal(options: Options) -> Iterator[Action]:
    """Yield what takes an installation away; configuration and data stay unless purged."""
    if options.live:
        for target in ("treedock.target", "treedock-station.target"):
            yield Run(("systemctl", "disable", "--now", target), "stop", may_fail=True)
        names = [name for name in units.files() if name.endswith(".service")]
        yield Run(("systemctl", "stop", *names), "stop", may_fail=True)
    for name in units.files():
        yield Remove(options.at(f"{UNIT_FOLDER}/{name}"))
    yield Remove(options.at(RULES))
    yield Remove(options.at(options.prefix))
    if options.purge:
        for path in ("/etc/treedock", f"/var/lib/{USER}", f"/var/cache/{USER}"):
            yield Remove(options.at(path))
    if options.live:
        yield Run(("systemctl", "daemon-reload"), "forget the units", may_fail=True)


def check(options: Options) -> None:
    """Refuse what cannot work before anything is touched.

    Raises:
        InstallError: with what to do.
    """
    if sys.version_info < _MIN_PYTHON:
        raise InstallError(
            f"Python {sys.version.split()[0]} is too old, 3.11 is needed: PYTHON=python3.11 deploy/install"
        )
    if not options.prefix.startswith("/"):
        raise InstallError(f"--prefix {options.prefix}: expected an absolute path, for example /opt/treedock")
    if options.live and not options.dry_run and os.geteuid() != 0:
        raise InstallError("this writes to /etc and /opt: run it with sudo, or look first with --dry-run")
    if options.live and not options.dry_run and shutil.which("systemctl") is None:
        raise InstallError("systemctl is not here: treedock runs as systemd units")
    allowed = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")
    if not options.uav or not set(options.uav) <= allowed:
        raise InstallError(f"--uav {options.uav!r}: letters, digits, _ and - make an aircraft's name")


def parse(arguments: Sequence[str]) -> tuple[str, Options]:
    """Return the verb and the options."""
    parser = argparse.ArgumentParser(prog="deploy/install", description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("verb", nargs="?", choices=("install", "uninstall"), default="install")
    parser.add_argument("--prefix", default=units.PREFIX, help="place of the private environment (default %(default)s)")
    parser.add_argument("--root", type=Path, default=Path("/"), help="stage below this folder instead of installing")
    parser.add_argument("--uav", default="uav1", help="the aircraft's name, a part of every key (default %(default)s)")
    parser.add_argument("--role", choices=("aircraft", "station"), default="aircraft", help="what --enable starts")
    parser.add_argument("--wheels", type=Path, help="folder of wheels for a machine without a network")
    parser.add_argument("--enable", action="store_true", help="start now and at every boot")
    parser.add_argument("--dry-run", action="store_true", help="show what would be done, do nothing")
    parser.add_argument(
        "--purge", action="store_true", help="uninstall: also configuration, certificates and recordings"
    )
    given = parser.parse_args(arguments)
    return given.verb, Options(
        given.prefix,
        given.root.absolute(),
        given.uav,
        given.role,
        given.dry_run,
        given.wheels,
        given.enable,
        given.purge,
    )


def main(arguments: Sequence[str]) -> int:
    """Install or uninstall; 0 done, 2 something is to be mended first."""
    verb, options = parse(arguments)
    try:
        check(options)
        for action in installation(options) if verb == "install" else removal(options):
            sys.stdout.write(action.describe() + "\n")
            sys.stdout.flush()
            if not options.dry_run:
                action.do()
    except (InstallError, OSError) as error:
        sys.stderr.write(f"deploy/install: {error}\n")
        return 2
    if verb == "install" and not options.dry_run and not options.enable and options.live:
        sys.stdout.write(f"installed; look at {options.at(CONFIG)}, then: systemctl enable --now treedock.target\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
