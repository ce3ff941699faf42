"""Files that a power cut leaves whole: the old content or the new one, never a part."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

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


def write_whole(path: Path, body: bytes, mode: int = 0o644) -> None:
    """Write ``body`` beside ``path``, flush it to the disk, and put it in its place; never readable beyond ``mode``.

    Raises:
        InputError: the disk refused; ``path`` is then as it was.
    """
    write_parts(path, (body,), mode)


def write_parts(path: Path, parts: Iterable[bytes], mode: int = 0o644) -> None:
    """Do as ``write_whole`` with a content too large to be held at once."""
    fresh = path.with_name(f".{path.name}.new")
    try:
        fresh.unlink(missing_ok=True)
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as out:
            for part in parts:
                out.write(part)
            out.flush()
            os.fsync(out.fileno())
        fresh.replace(path)
        above = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(above)  # the new name itself, not the content alone
        finally:
            os.close(above)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
