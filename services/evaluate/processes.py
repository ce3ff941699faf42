"""Services as processes of their own, for benchmarks that watch them from outside: started, looked after, ended."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Self

from services.common.config import TreedockConfig
from services.common.errors import InputError

_LOOK_S = 0.02


class Processes:
    """The services' processes; all are gone at the end."""

    def __init__(self, config: TreedockConfig, folder: Path) -> None:
        self._folder = folder
        self.config_file = folder / "config.json"
        self.config_file.write_text(config.model_dump_json(), encoding="utf-8")
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        return self

    def start(self, name: str) -> None:
        """Start a service."""
        self.spawn(name, "services.cli.app", name, "--config", str(self.config_file), "--parent", str(os.getpid()))

    def spawn(self, name: str, module: str, *arguments: str) -> None:
        """Start ``python -m module arguments`` under a name."""
        command = [sys.executable, "-m", module, *arguments]
        with (self._folder / f"{name}.log").open("wb") as log:
            self._processes[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def pid(self, name: str) -> int:
        """Return the number of a process."""
        return self._processes[name].pid

    def check(self) -> None:
        """Raise InputError with the last words of a service that ended."""
        for name, process in self._processes.items():
            if process.poll() is not None:
                lines = (self._folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
                raise InputError(f"{name} ended with {process.returncode}: {lines[-1] if lines else 'it said nothing'}")

    def __exit__(self, *_: object) -> None:
        for name in reversed(list(self._processes)):
            self.stop(name)

    def stop(self, name: str) -> None:
        """Stop one process."""
        process = self._processes.pop(name)
        process.terminate()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until ``condition``.

        Raises:
            InputError: it did not come true in time, or a service ended.
        """
        end_s = time.monotonic() + timeout_s
        while not condition():
            self.check()
            if time.monotonic() > end_s:
                raise InputError(f"waited {timeout_s:.0f} s for {what}")
            time.sleep(_LOOK_S)

    def cpu_s(self, name: str) -> float:
        """Return the CPU time that a service has used, all threads (proc(5): utime and stime of stat)."""
        fields = self._proc(name, "stat").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self, name: str, *, peak: bool = False) -> float:
        """Return the memory that a service holds (VmRSS), or the most that it has held (VmHWM), MB."""
        key = "VmHWM" if peak else "VmRSS"
        lines = self._proc(name, "status").splitlines()
        return next((int(line.split()[1]) / 1024.0 for line in lines if line.startswith(key)), 0.0)

    def _proc(self, name: str, what: str) -> str:
        return Path(f"/proc/{self._processes[name].pid}/{what}").read_text(encoding="ascii")
