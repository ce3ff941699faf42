"""How much memory a process may lock: Zenoh's shared memory is locked, and silently off where too little may be."""

from __future__ import annotations

from pathlib import Path

UNLIMITED = -1
ENOUGH_BYTES = 64 * 1024 * 1024
_CAP_IPC_LOCK = 1 << 14
"""linux/capability.h: whoever has it may lock whatever the limit says. Root has it, but for in some containers."""


def lockable_bytes(pid: int | str = "self", proc: Path = Path("/proc")) -> int | None:
    """Return what a process may lock as really in force, ``UNLIMITED`` for any amount, None when that cannot be told."""
    try:
        status = (proc / str(pid) / "status").read_text()
        limits = (proc / str(pid) / "limits").read_text()
    except OSError:
        return None
    capabilities = next((line.split()[1] for line in status.splitlines() if line.startswith("CapEff:")), "0")
    if int(capabilities, 16) & _CAP_IPC_LOCK:
        return UNLIMITED
    words = next((line.split() for line in limits.splitlines() if line.startswith("Max locked memory")), None)
    if words is None:
        return None
    return UNLIMITED if words[3] == "unlimited" else int(words[3])


def too_little(lockable: int | None) -> bool:
    """Whether so little may be locked that frames are copied instead; what cannot be told is not."""
    return lockable is not None and 0 <= lockable < ENOUGH_BYTES
