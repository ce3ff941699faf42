"""LAS and LAZ files. LAZ is unpacked by a process of its own: ``python -m services.detector.readers_las FILE``.

The decompressor is Rust: damage that it does not expect ends the process that it runs in, and there is nothing to catch
(found by fuzzing: a damaged count of chunks, damaged sizes of items). What is ended so is a child, and the file is told as damaged.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.common.process import die_with_parent
from services.detector.las_header import announced_too_much, is_compressed

Floats = NDArray[np.float64]

_MODULE = "services.detector.readers_las"
_REFUSED = 3
"""Exit code of the child that says on stderr what is wrong with the file."""
_PATIENCE_S, _PATIENCE_S_PER_MB = 60.0, 2.0
"""A child that takes longer hangs: it unpacks 20 MB a second and more."""


def read_las(path: Path) -> Floats:
    """Return the points (N, 3) of a LAS or LAZ file, metres.

    Raises:
        InputError: naming the file and what is wrong with it.
    """
    if too_much := announced_too_much(path):
        raise InputError(f"{path}: not a whole LAS/LAZ file: its header announces {too_much}")
    return _unpacked(path) if is_compressed(path) else _points(path)


def _points(path: Path) -> Floats:
    import laspy

    try:
        las = laspy.read(path)
        expected = int(las.header.point_count)
        points = np.stack([np.asarray(las.x), np.asarray(las.y), np.asarray(las.z)], axis=1)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # laspy and its decompressor raise many kinds, also bare struct and Rust errors
        text = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(f"{path}: not a whole LAS/LAZ file: {text}") from error
    if len(points) < expected:
        raise InputError(f"{path}: cut short: {len(points)} points of the {expected} its header announces")
    return points


def _unpacked(path: Path) -> Floats:
    """Return the points that a child reads; its pipe carries their number, then x y z of each."""
    patience_s = _PATIENCE_S + _PATIENCE_S_PER_MB * path.stat().st_size / 1e6
    code = os.pathsep.join(filter(None, [str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH")]))
    with (
        tempfile.TemporaryFile() as said,  # a pipe that nobody empties would hold the child up
        subprocess.Popen(
            [sys.executable, "-m", _MODULE, str(path)],
            stdout=subprocess.PIPE, stderr=said, env=os.environ | {"PYTHONPATH": code},
        ) as child,
    ):  # fmt: skip
        impatient = threading.Timer(patience_s, child.kill)
        impatient.start()
        assert child.stdout is not None
        try:
            points = _received(child.stdout)
        finally:
            child.stdout.close()
            child.wait()
            impatient.cancel()
        said.seek(0)
        words = said.read().decode(errors="replace").strip()
    if points is not None and child.returncode == 0:
        return points
    if child.returncode == _REFUSED:
        raise InputError(words)
    raise InputError(f"{path}: not a whole LAS/LAZ file: its points cannot be unpacked")


def _received(pipe: IO[bytes]) -> Floats | None:
    """Return what a child sent, None when it ended before all of it."""
    head = pipe.read(8)
    if len(head) < 8:
        return None
    points = np.empty((int.from_bytes(head, "little"), 3))
    rest = points.data.cast("B")
    while len(rest):
        part = pipe.read(min(len(rest), 1 << 24))
        if not part:
            return None
        rest[: len(part)] = part
        rest = rest[len(part) :]
    return points


def main(path: Path) -> int:
    """Send the points of a LAZ file to stdout, or say on stderr why not; return the exit code."""
    die_with_parent()
    try:
        points = _points(path)
    except (InputError, OSError, MemoryError) as error:
        sys.stderr.write(str(error) if isinstance(error, InputError) else f"{path}: cannot be read: {error}")
        return _REFUSED
    sys.stdout.buffer.write(len(points).to_bytes(8, "little"))
    sys.stdout.buffer.write(np.ascontiguousarray(points, "<f8").data.cast("B"))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
