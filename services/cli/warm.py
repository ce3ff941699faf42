"""``treedock warm``: compile every kernel once, so that no service compiles in flight."""

from __future__ import annotations

import importlib
import time

PACKAGES = (
    "services.camera",
    "services.slam",
    "services.mapper",
    "services.detector",
    "services.detector.refine",
    "services.simulator",
)


def warm() -> None:
    """Compile (or load from the cache) the numba kernels of every package; run after an install or an update."""
    from rich.console import Console

    console = Console(stderr=True)
    for name in PACKAGES:
        begin = time.perf_counter()
        compile_kernels = getattr(importlib.import_module(f"{name}.warm"), "warm", None)
        if compile_kernels is None:
            continue
        compile_kernels()
        console.print(f"warm: {name.removeprefix('services.')} {time.perf_counter() - begin:.1f} s", highlight=False)
