"""Mends what an earlier recorder left cut, in a process of its own: a new recorder records at once, however much there is to mend.

``python -m services.recorder.mender FOLDER RESERVE_MB`` does it: a line for each recording, exit code 1 when one had to be left.
"""

from __future__ import annotations

import contextlib
import logging
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from services.common.errors import InputError
from services.common.process import die_with_parent, give_way
from services.recorder.recover import cut_recordings, recover
from services.recorder.space import free_bytes

if TYPE_CHECKING:
    from services.common.context import HealthBook

LOG = logging.getLogger(__name__)

_NICE = 10
_STOP_S = 0.2


class Mender:
    """The process, begun where there is something to mend; ``look`` now and then brings its outcome into health."""

    def __init__(self, folder: Path, reserve_mb: int) -> None:
        self._process: subprocess.Popen[str] | None = None
        if cut_recordings(folder):
            command = [sys.executable, "-m", "services.recorder.mender", str(folder), str(reserve_mb)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
            )

    def look(self, health: HealthBook) -> None:
        """Tell what became of it, once it is done."""
        if self._process is None or self._process.poll() is None:
            return
        mended, left = self._process.communicate()
        for line in mended.splitlines():
            LOG.info("%s", line)
            health.count("recordings_mended")
        if self._process.returncode:
            last = (left.strip().splitlines() or ["the mender ended without a word"])[-1]
            health.note("recordings", f"{last}; `treedock recordings --recover` tries again")
        self._process = None

    def stop(self) -> None:
        """End it; what it was at is as it was before."""
        if self._process is None:
            return
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.communicate(timeout=_STOP_S)
        self._process = None


def mend(folder: Path, reserve_bytes: int) -> int:
    """Mend each cut recording for which there is room beside the reserve; return how many had to be left."""
    left = 0
    for path in cut_recordings(folder):
        try:
            if free_bytes(folder) - path.stat().st_size < reserve_bytes:
                raise InputError(f"{path}: was cut short, and there is no room to write it anew")
            sys.stdout.write(f"{recover(path)}\n")
        except (InputError, OSError) as error:
            sys.stderr.write(f"{error}\n")
            left += 1
    return left


if __name__ == "__main__":
    die_with_parent()
    give_way(_NICE)
    sys.exit(1 if mend(Path(sys.argv[1]), int(sys.argv[2]) * 1_000_000) else 0)
