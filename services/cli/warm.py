"""``treedock warm``: compile every kernel once, so that no service compiles in flight."""

from __future__ import annotations

import importlib
import time
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
    """Compile (or load from the cache) the numba kernels of every package; run after an install or an update."""
    from rich.console import Console

    console = Console(stderr=True)
    for name in PACKAGES:
        if aboard and name in NOT_ABOARD:
            continue
        begin = time.perf_counter()
        compile_kernels = getattr(importlib.import_module(f"{name}.warm"), "warm", None)
        if compile_kernels is None:
            continue
        compile_kernels()
        console.print(f"warm: {name.removeprefix('services.')} {time.perf_counter() - begin:.1f} s", highlight=False)
