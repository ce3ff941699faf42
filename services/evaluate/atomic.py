"""A set of result files appears whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from services.common.errors import InputError


def prepare(out: Path) -> None:
    """Check that results can be written to the folder ``out``, before the long work.

    Raises:
        InputError: it is a file, or no folder above it can be written.
    """
    try:
        if out.exists() and not out.is_dir():
            raise InputError(f"{out}: is a file; --out names a folder")
        nearest = out.absolute()
        while not nearest.exists():
            nearest = nearest.parent
        if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
            raise InputError(f"{out}: cannot be written: {nearest} is no folder that this user may write to")
        tempfile.TemporaryDirectory(dir=nearest).cleanup()  # permissions alone do not tell: /proc, a full disk
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from None


def write_files(out: Path, files: dict[str, bytes]) -> None:
    """Write ``files`` (name to content) into ``out`` through a folder inside it, or beside it while there is no ``out``.

    Inside, because the folder above may be closed to this user, or another disk.

    Raises:
        InputError: the disk refused; ``out`` is then as it was.
    """
    place = out.absolute()
    partial = (place if place.is_dir() else place.parent) / f".{place.name}.partial-{os.getpid()}"
    try:
        partial.mkdir(parents=True)
        for name, content in files.items():
            with (partial / name).open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
        if out.exists():
            for name in files:
                (partial / name).replace(out / name)
        else:
            partial.rename(out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
