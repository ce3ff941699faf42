"""Files that a power cut leaves whole: the old content or the new one, never a part."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from services.common.errors import InputError


def make_folder(folder: Path, mode: int = 0o755) -> None:
    """Make a folder and those above it.

    Raises:
        InputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=mode)
    except OSError as error:
        raise InputError(f"{folder}: {error.strerror}; name a folder that you can write") from error


def is_there(path: Path) -> bool:
    """Return whether there is such a file.

    Raises:
        InputError: this user may not look into its folder, which is no reason to call it missing.
    """
    try:
        return path.is_file()
    except PermissionError as error:
        raise InputError(f"{path}: this user may not look there; sudo, or the services' own user, may") from error


def write_whole(
    path: Path, body: bytes, mode: int = 0o644, *, lasting: bool = True, like: os.stat_result | None = None
) -> None:
    """Write ``body`` beside ``path``, flush it to the disk, and put it in its place; never readable beyond ``mode``.

    ``like``: of the file whose owner and rights it takes, whatever the umask says.

    ``lasting=False`` does not wait for the disk: whole for whoever comes after a process that was killed, not after a power
    cut.

    Raises:
        InputError: the disk refused; ``path`` is then as it was.
    """
    write_parts(path, (body,), mode, lasting=lasting, like=like)


def write_parts(
    path: Path, parts: Iterable[bytes], mode: int = 0o644, *, lasting: bool = True, like: os.stat_result | None = None
) -> None:
    """Do as ``write_whole`` with a content too large to be held at once."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        fresh.unlink(missing_ok=True)
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as out:
            if like is not None:
                make_alike(out.fileno(), like)
            for part in parts:
                out.write(part)
            out.flush()
            if lasting:
                os.fsync(out.fileno())
        fresh.replace(path)
        if lasting:
            _sync_names(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error


def locked_beside(path: Path, about: str, taken: str) -> TextIO:
    """Keep other processes out of ``path`` by a lock file beside it, which is closed to let go; its folder is made.

    Args:
        path: what is kept.
        about: what that is, for the error.
        taken: what is wrong, and what to do, when another process has it.

    Raises:
        InputError: another process has it, or the lock file cannot be written.
    """
    file = path.parent / f".{path.name}.lock"
    make_folder(path.parent)
    try:
        lock = file.open("w")
    except OSError as error:
        do = "it has to be writable for whom keeps it, as the services' user"
        raise InputError(f"{about} {path}: {file} cannot be opened: {error.strerror}; {do}") from error
    with contextlib.suppress(PermissionError):  # an administrator's would keep the services out afterwards
        owner = path.parent.stat()
        os.fchown(lock.fileno(), owner.st_uid, owner.st_gid)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.close()
        raise InputError(f"{about} {path}: {taken}") from None
    return lock


def make_alike(handle: int, like: os.stat_result) -> None:
    """Give an open file owner and rights of another, as far as this user may."""
    with contextlib.suppress(PermissionError):  # only root may give files away, and only root needs to
        os.fchown(handle, like.st_uid, like.st_gid)
    os.fchmod(handle, like.st_mode & 0o777)


def _sync_names(folder: Path) -> None:
    """Flush a folder: the new name itself, not the content alone."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
