"""How a run starts the commands that it watches over."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def started(arguments: Sequence[str], config: Path, log: Path, out: Path | None = None) -> subprocess.Popen[bytes]:
    """Start a treedock command as a process group of its own: Ctrl-C in the terminal reaches it through us alone.

    What it says goes to the end of ``log``, its standard output to ``out`` where one is given.
    """
    command = [sys.executable, "-m", "services.cli.app", *arguments, "--config", str(config)]
    # the file already holds what variables and flags said
    environment = {k: v for k, v in os.environ.items() if not k.startswith("TREEDOCK_") or k == "TREEDOCK_DATA"}
    with log.open("ab") as errors, (out or log).open("ab") as told:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=told, stderr=errors, env=environment, process_group=0
        )


def last_line(path: Path) -> str:
    """Return what a process wrote last."""
    lines = path.read_text(errors="replace").strip().splitlines() if path.exists() else []
    return lines[-1] if lines else "it said nothing"
