"""``treedock warm``: compile every kernel and module once, so that no service compiles in flight."""

from __future__ import annotations

import compileall
import importlib
import time
from pathlib import Path
from typing import Annotated

import typer

PACKAGES = (
    "services.camera",
    "services.slam",
    "services.mapper",
    "services.detector",
    "services.detector.refine",
    "services.simulator",
)
NOT_ABOARD = frozenset({"services.simulator"})
"""What no aircraft runs; compiling it would double the time."""


def warm(
    *, aboard: Annotated[bool, typer.Option("--aboard", help="Only what an aircraft's services run.")] = False
) -> None:
    """Compile (or load from the cache) the numba kernels of every package, and its Python; run after an install or an update."""
    from rich.console import Console

    console = Console(stderr=True)
    begin = time.perf_counter()
    compile_python(Path(__file__).parents[2])
    console.print(f"warm: python {time.perf_counter() - begin:.1f} s", highlight=False)
    for name in PACKAGES:
        if aboard and name in NOT_ABOARD:
            continue
        begin = time.perf_counter()
        compile_kernels = getattr(importlib.import_module(f"{name}.warm"), "warm", None)
        if compile_kernels is None:
            continue
        compile_kernels()
        console.print(f"warm: {name.removeprefix('services.')} {time.perf_counter() - begin:.1f} s", highlight=False)


def compile_python(root: Path) -> bool:
    """Compile the modules below ``root`` to bytecode where that is missing or old; return whether all of it is there now.

    Python does that by itself when it may write, and PYTHONDONTWRITEBYTECODE is not set: on a machine where it may not, each
    service would compile 90 modules at every start (0.1 s). A folder that cannot be written to is left as it is.
    """
    return all(compileall.compile_dir(root / package, quiet=2) for package in ("schemas", "services"))
