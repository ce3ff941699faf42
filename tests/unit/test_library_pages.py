"""The compiler's pages are let go, and it works all the same when it is needed again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from services.common.library_pages import let_go_of

ROOT = Path(__file__).parents[2]

_COMPILE_TWICE = """
import re
import numba
import numpy as np
from services.common.library_pages import COMPILER, let_go_of

def files_mb():
    with open("/proc/self/status") as file:
        return int(re.search(r"RssFile:\\s+(\\d+)", file.read())[1]) / 1024

def doubled(x):
    return 2.0 * x.sum()

def halved(x):
    return 0.5 * x.sum()

first = numba.njit(doubled)(np.ones(5))
before_mb = files_mb()
gone = let_go_of(COMPILER)
after_mb = files_mb()
second = numba.njit(halved)(np.ones(5))
print(first, second, gone, before_mb - after_mb)
"""


def test_the_compiler_holds_no_memory_between_two_kernels() -> None:
    out = subprocess.check_output([sys.executable, "-c", _COMPILE_TWICE], cwd=ROOT, text=True)
    first, second, gone, freed_mb = map(float, out.split())
    assert (first, second) == (10.0, 2.5)
    assert gone > 50e6
    assert freed_mb > 40.0


def test_a_library_that_is_not_loaded_is_no_fault() -> None:
    assert let_go_of("libnothing-of-that-name") == 0


def test_pages_that_the_process_made_its_own_are_kept() -> None:
    """The C library's relocated pages are read-only by now; without them the next call would be the last."""
    assert let_go_of("libc.so") > 0
    assert subprocess.run([sys.executable, "-c", "pass"], check=False).returncode == 0
