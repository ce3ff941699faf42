"""A machine of its own for the units: systemd as PID 1 in namespaces, on an overlay of this one's files."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

_BOOT = """
set -e
M=$1/root
mount -t overlay overlay -o lowerdir=/,upperdir=$1/upper,workdir=$1/work $M
mount -t proc proc $M/proc
mount -t tmpfs tmpfs $M/run
mount --rbind /dev $M/dev
mount -t sysfs sysfs $M/sys 2>/dev/null || mount --rbind /sys $M/sys
umount -l $M/sys/fs/cgroup 2>/dev/null || true
mount -t cgroup2 cgroup2 $M/sys/fs/cgroup
cp -r $1/add/. $M/
ip link set lo up
export container=docker
exec chroot $M /lib/systemd/systemd --system --unit=basic.target --show-status=false --log-target=null
"""
_NAMESPACES = ("--mount", "--pid", "--ipc", "--uts", "--cgroup", "--net")


def missing() -> str:
    """Return why such a machine cannot be made here, empty when it can."""
    if os.geteuid() != 0:
        return "needs root for its namespaces"
    lacking = [tool for tool in ("unshare", "nsenter", "systemctl", "ip") if shutil.which(tool) is None]
    if lacking or not Path("/lib/systemd/systemd").exists():
        return f"needs {', '.join(lacking) or 'systemd'}"
    probe = ["unshare", *_NAMESPACES, "--fork", "true"]
    if subprocess.run(probe, capture_output=True, check=False).returncode != 0:
        return "namespaces are not allowed here"
    return ""


class Machine:
    """The booted machine; files laid in ``add`` before ``boot`` are in its root."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        for name in ("root", "upper", "work", "add"):
            (folder / name).mkdir()
        self.add = folder / "add"
        # an empty file in place of the system's: booting would empty /tmp, where the checkout may lie
        (self.add / "etc/tmpfiles.d").mkdir(parents=True)
        (self.add / "etc/tmpfiles.d/tmp.conf").touch()
        self._process: subprocess.Popen[bytes] | None = None
        self._first = 0

    def boot_log(self) -> str:
        """Return what was said while it came up."""
        return (self._folder / "boot.log").read_text()

    def boot(self) -> bool:
        """Start systemd and wait until it answers; False when this machine cannot host it."""
        command = [
            "unshare",
            *_NAMESPACES,
            "--fork",
            "--kill-child=SIGKILL",
            "bash",
            "-c",
            _BOOT,
            "boot",
            str(self._folder),
        ]
        with (self._folder / "boot.log").open("wb") as log:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                return False
            children = subprocess.run(
                ["pgrep", "-P", str(self._process.pid)], capture_output=True, text=True, check=False
            )
            if children.stdout.split():
                self._first = int(children.stdout.split()[0])
                if self.run("systemctl", "is-system-running").stdout.strip() in {"running", "degraded"}:
                    return True
            time.sleep(0.2)
        return False

    def run(self, *command: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
        """Run a command inside."""
        entered = ["nsenter", "-t", str(self._first), *_NAMESPACES, "--root", "--wd", *command]
        return subprocess.run(entered, capture_output=True, text=True, timeout=timeout_s, check=False)

    def show(self, unit: str, name: str) -> str:
        """Return a property of a unit."""
        return self.run("systemctl", "show", unit, "-p", name, "--value").stdout.strip()

    def wait(self, unit: str, name: str, value: str, within_s: float) -> float:
        """Wait until a property has a value; return the seconds it took."""
        begin = time.monotonic()
        while (found := self.show(unit, name)) != value:
            assert time.monotonic() - begin < within_s, f"{unit}: {name} is {found}, not {value}\n{self.journal(unit)}"
            time.sleep(0.05)
        return time.monotonic() - begin

    def signal(self, unit: str, number: signal.Signals) -> None:
        """Send a signal to the unit's main process."""
        self.run("systemctl", "kill", "--kill-whom=main", f"--signal={number.name}", unit)

    def journal(self, unit: str) -> str:
        """Return what the unit said."""
        return self.run("journalctl", "--no-pager", "-n", "40", "-u", unit).stdout

    def end(self) -> None:
        """Kill the whole machine."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
