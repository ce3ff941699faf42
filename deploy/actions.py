"""What an installation is made of: files, folders, commands; each says what it will do, and does it once.

Standard library only: it runs before anything is installed.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path


class InstallError(Exception):
    """What the person at the keyboard has to mend first."""


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
class Link:
    """A name that leads to a file; one of somebody else's is left alone."""

    path: Path
    to: str

    def _present(self) -> bool:
        return self.path.is_symlink() or self.path.exists()

    def _ours(self) -> bool:
        return self.path.is_symlink() and str(self.path.readlink()).endswith("/bin/treedock")

    def describe(self) -> str:
        """Return the line for the person who watches."""
        if self.path.is_symlink() and str(self.path.readlink()) == self.to:
            return f"same    {self.path}"
        return f"keep    {self.path}" if self._present() and not self._ours() else f"link    {self.path} -> {self.to}"

    def do(self) -> None:
        """Do it."""
        if not self.describe().startswith("link"):
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(self.to)


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
        return f"run     {' '.join(self.command)}   ({self.why})" if self.needed else f"have    {self.why}"

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
            sys.stdout.write(f"        that failed, the rest goes on ({self.why})\n")


@dataclass(frozen=True)
class Remove:
    """A file or folder that goes."""

    path: Path

    def describe(self) -> str:
        """Return the line for the person who watches."""
        return f"{'remove ' if self.path.exists() or self.path.is_symlink() else 'gone   '} {self.path}"

    def do(self) -> None:
        """Do it."""
        if self.path.is_dir() and not self.path.is_symlink():
            shutil.rmtree(self.path)
        else:
            self.path.unlink(missing_ok=True)


Action = Write | Folder | Link | Run | Remove
