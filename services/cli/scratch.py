"""The folder in which a run keeps its configuration and logs, and what dead runs left behind."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from pathlib import Path

_PREFIX = "treedock-run-"
_OWNER = "owner"


def made() -> Path:
    """Return a new folder of this process, after clearing away those of runs that were killed."""
    clear_stale(Path(tempfile.gettempdir()))
    folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
    (folder / _OWNER).write_text(f"{os.getpid()} {_began(os.getpid())}")
    return folder


def let_go(folder: Path, *, keep: bool) -> None:
    """Remove a folder that ``made`` gave, or keep it for the user to read: then nobody clears it away."""
    if keep:
        with contextlib.suppress(OSError):
            (folder / _OWNER).unlink(missing_ok=True)
    else:
        shutil.rmtree(folder, ignore_errors=True)


def clear_stale(parent: Path) -> list[Path]:
    """Remove the folders below ``parent`` whose run is dead; return them. Those kept on purpose name no owner."""
    gone = []
    for folder in sorted(parent.glob(f"{_PREFIX}*")):
        try:
            number, began = (folder / _OWNER).read_text().split()
        except (OSError, ValueError):
            continue
        if not number.isdecimal() or _began(int(number)) == began:
            continue
        shutil.rmtree(folder, ignore_errors=True)
        gone.append(folder)
    return gone


def _began(pid: int) -> str:
    """Return when a process began, in the kernel's ticks: its number alone may be another's by now. "0": no such one."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return "0"
    return stat.rpartition(")")[2].split()[19]
