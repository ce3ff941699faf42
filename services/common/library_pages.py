"""Pages of a loaded library that nobody needs any more are let go: LLVM after the kernels came from the cache.

A library's file is mapped, and what was touched of it stays in the process's resident memory for good. How much that is, is chance:
where the file was last read in one go the kernel maps it in large pieces (108 or 176 MB of LLVM alone, on one machine).
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
from collections.abc import Iterator
from pathlib import Path

import numpy as np

COMPILER = "libllvmlite"
_MADV_DONTNEED = 4
_PRESENT, _SWAPPED, _OF_A_FILE = np.uint64(1 << 63), np.uint64(1 << 62), np.uint64(1 << 61)
_MAPS, _PAGEMAP = Path("/proc/self/maps"), Path("/proc/self/pagemap")


def let_go_of(library: str) -> int:
    """Drop the resident pages of a library; what is needed again comes back from its file by itself.

    Only mappings that can't be written and hold no page of this process's own (relocated ones would be lost) are touched.
    Elsewhere than on Linux nothing happens.

    Args:
        library: how the file's name begins.

    Returns:
        The bytes of the mappings that were let go.
    """
    gone = 0
    with contextlib.suppress(OSError, AttributeError, ValueError):
        libc = ctypes.CDLL(None, use_errno=True)
        for begin, end in _read_only(library):
            if (
                _clean(begin, end)
                and libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED) == 0
            ):
                gone += end - begin
    return gone


def _read_only(library: str) -> Iterator[tuple[int, int]]:
    """Give the address ranges at which a library is mapped without the right to write (man proc_pid_maps)."""
    for line in _MAPS.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split(maxsplit=5)
        if len(words) == 6 and words[1] in {"r--p", "r-xp"} and words[5].rpartition("/")[2].startswith(library):
            begin, _, end = words[0].partition("-")
            yield int(begin, 16), int(end, 16)


def _clean(begin: int, end: int) -> bool:
    """Return whether every page there is the file's, none this process's own copy (Linux, admin-guide/mm/pagemap)."""
    count = (end - begin) // mmap.PAGESIZE
    with _PAGEMAP.open("rb", buffering=0) as file:
        file.seek(begin // mmap.PAGESIZE * 8)
        pages = np.frombuffer(file.read(8 * count), np.uint64)
    held = (pages & (_PRESENT | _SWAPPED)) != 0
    return len(pages) == count and not bool(np.any(held & ((pages & _OF_A_FILE) == 0)))
