"""What must be set in a process before heavy libraries are imported. Imports nothing heavy itself."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path

from services.common.kernel_cache import drop_stale

_PR_SET_PDEATHSIG = 1
BACKGROUND: Mapping[str, int] = {"mapper": 10, "detector": 10, "recorder": 10, "preview": 10}
"""Niceness of services that may be late: nobody flies by them within a frame. Under systemd CPUWeight does the same."""
_STARTING_OBJECTS = 50_000
"""New objects between two looks of the garbage collector while libraries load: the usual 700 cost a fifth of the start."""
_USUAL = gc.get_threshold()
_SMALL_BYTES = 400
"""Python keeps objects of up to 512 bytes, head included, in room of its own."""
_KEPT: list[bytes] = []


def prepare_process() -> None:
    """Set what heavy libraries read at import: a writable numba cache without stale kernels, one thread each, no search for plugins.

    The garbage collector looks seldom until ``started``.
    """
    # beside the code the cache would need write access that a deployment does not give
    os.environ.setdefault("NUMBA_CACHE_DIR", str(_kernel_cache()))
    drop_stale(Path(os.environ["NUMBA_CACHE_DIR"]), Path(__file__).absolute().parents[2])
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.set_threshold(_STARTING_OBJECTS)


def _kernel_cache() -> Path:
    """Return a folder that this user can write: of somebody without a home a temporary one."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "treedock" / "numba"
    try:
        cache.mkdir(parents=True, exist_ok=True)
    except OSError:
        return Path(tempfile.gettempdir()) / f"treedock-{os.getuid()}" / "numba"
    return cache


def started() -> None:
    """Take what is loaded out of the garbage collector's sight: a look over it all would hold a frame up for 0.1 s."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*_USUAL)


def die_with_parent() -> None:
    """Have the kernel send SIGTERM when the process that started this one ends (Linux; man prctl)."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM))


def give_way(nice: int) -> None:
    """Let the calling thread run after others of its program where the processor is short (Linux: niceness is per thread).

    A sandbox may forbid it: the work is done all the same, only not last.
    """
    with contextlib.suppress(PermissionError):
        me = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, me, min(os.getpriority(os.PRIO_PROCESS, me) + nice, 19))


def give_back_memory() -> None:
    """Give the machine back what was freed but is still held by the allocator (glibc), and the pages of the kernels' compiler."""
    with contextlib.suppress(AttributeError, OSError):
        ctypes.CDLL(None).malloc_trim(0)
    if "llvmlite" in sys.modules:
        from services.common.library_pages import COMPILER, let_go_of

        let_go_of(COMPILER)


def take_small_arrays() -> None:
    """Have numpy take at once what it keeps of freed arrays: seven of each size below 1 KB, 4 MB in all.

    A service whose arrays are of many lengths takes it anyway, over an hour of flight, and that cannot be told from a leak.
    """
    import numpy as np

    for nbytes in range(1, 1024):
        _ = [np.empty(nbytes, np.uint8) for _ in range(7)]


def take_small_objects(megabytes: int = 3) -> None:
    """Have Python take at once the room for so many more small objects than are alive now, and keep it.

    It takes room by the megabyte when a busy moment makes more objects than ever before, and rarely gives it back: over an hour of
    flight that, too, looks like a leak.
    """
    held = [bytes(_SMALL_BYTES) for _ in range(megabytes * 2**20 // (_SMALL_BYTES + sys.getsizeof(b"")))]
    _KEPT.extend(held[:: len(held) // (4 * megabytes)])  # a megabyte in which one lives is not given back
