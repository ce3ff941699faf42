"""Several machines on one: network namespaces joined by a bridge, each with a shared memory of its own. Linux, iproute2.

``HUB`` is the machine that the others are wired to; it is this process's own network namespace, so the process must have
been started in a fresh one (``unshare --net --mount``, by root or with ``--map-root-user``): nothing of the machine's network is
touched, and everything is gone with the processes.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

from services.common.errors import InputError

HUB = "10.77.0.1"
_PREFIX = "10.77.0."
_TOOLS = ("ip", "unshare", "nsenter", "setpriv")
_PROBE = """
ip link add hub type bridge
ip link add one type veth peer name other
mount -t tmpfs tmpfs /dev/shm
unshare --net --mount --ipc -- true
"""
"""All that is needed of the kernel, tried once."""


def why_not() -> str:
    """Return why namespaces cannot be made here, nothing when they can."""
    missing = [tool for tool in _TOOLS if shutil.which(tool) is None]
    if missing:
        return f"{', '.join(missing)} not installed (Debian: iproute2, util-linux)"
    tried = subprocess.run([*enter_fresh(), "sh", "-ec", _PROBE], capture_output=True, text=True, check=False)
    return f"no network namespaces here: {tried.stderr.strip()[:200]}" if tried.returncode else ""


def enter_fresh() -> list[str]:
    """Return the words before a command that give it a network and mounts of its own."""
    return ["unshare", *([] if os.geteuid() == 0 else ["--map-root-user"]), "--net", "--mount", "--"]


@dataclass
class Hosts:
    """The machines ``names``; a context manager. ``run_on(name)`` gives the words before a command that runs there."""

    names: tuple[str, ...]
    _holders: dict[str, subprocess.Popen[str]] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        _do("ip", "link", "set", "lo", "up")
        _do("ip", "link", "add", "hub", "type", "bridge")
        _do("ip", "addr", "add", f"{HUB}/24", "dev", "hub")
        _do("ip", "link", "set", "hub", "up")
        try:
            for number, name in enumerate(self.names, start=2):
                self._add(name, f"{_PREFIX}{number}")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for holder in self._holders.values():
            holder.kill()
            holder.wait()
        subprocess.run(["ip", "link", "del", "hub"], capture_output=True, check=False)

    def _add(self, name: str, address: str) -> None:
        # frames must not pass through a memory that two machines would not share
        held = "mount -t tmpfs tmpfs /dev/shm && ip link set lo up && echo up && exec sleep infinity"
        holder = subprocess.Popen(
            ["unshare", "--net", "--mount", "--ipc", "--", "setpriv", "--pdeathsig", "KILL", "sh", "-c", held],
            stdout=subprocess.PIPE,
            text=True,
        )
        self._holders[name] = holder
        assert holder.stdout is not None
        if holder.stdout.readline() != "up\n":
            raise InputError(f"the namespace of {name} could not be made")
        _do("ip", "link", "add", f"to-{name}", "type", "veth", "peer", "name", "net0", "netns", str(holder.pid))
        _do("ip", "link", "set", f"to-{name}", "master", "hub")
        _do("ip", "link", "set", f"to-{name}", "up")
        inside = self.run_on(name)
        _do(*inside, "ip", "addr", "add", f"{address}/24", "dev", "net0")
        _do(*inside, "ip", "link", "set", "net0", "up")

    def run_on(self, name: str) -> list[str]:
        """Return the words before a command that runs on a machine, in the folder of this process."""
        return ["nsenter", "-t", str(self._holders[name].pid), "--net", "--mount", "--ipc", f"--wd={Path.cwd()}", "--"]

    def wire(self, name: str, *, up: bool) -> None:
        """Plug a machine's cable in, or pull it."""
        _do("ip", "link", "set", f"to-{name}", "up" if up else "down")

    def sent_to(self, name: str) -> int:
        """Return how many bytes went over the wire to a machine so far."""
        # not from /sys, which shows the network that it was mounted in
        told = subprocess.run(
            ["ip", "-json", "-stats", "link", "show", f"to-{name}"], capture_output=True, text=True, check=True
        )
        return int(json.loads(told.stdout)[0]["stats64"]["tx"]["bytes"])


def _do(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"{' '.join(words)}: {done.stderr.strip()}")
