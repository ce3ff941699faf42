"""What every benchmark takes and gives, and where each one lives."""

from __future__ import annotations

import hashlib
import importlib
import os
import platform
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

from services.common.errors import InputError

BENCHES: dict[str, str] = {
    "catalogue": "services.evaluate.bench_catalogue",
    "detection": "services.evaluate.bench_detection",
    "mapper": "services.evaluate.bench_mapper",
    "fine": "services.evaluate.bench_fine",
    "fusion": "services.evaluate.bench_fusion",
    "cameras": "services.evaluate.bench_cameras",
    "peers": "services.evaluate.bench_peers",
    "slam": "services.evaluate.bench_slam",
    "slam-long": "services.evaluate.bench_slam_long",
    "refine": "services.evaluate.bench_refine",
    "latency": "services.evaluate.bench_latency",
    "depth": "services.evaluate.bench_depth",
    "missions": "services.evaluate.bench_missions",
    "avoid": "services.evaluate.bench_avoid",
    "fleet": "services.evaluate.bench_fleet",
    "fleet-capacity": "services.evaluate.bench_fleet_capacity",
    "system": "services.evaluate.bench_system",
    "station": "services.evaluate.bench_station",
    "faults": "services.evaluate.bench_faults",
    "soak": "services.evaluate.bench_soak",
}
"""Name of a benchmark -> module with ``run(options: BenchOptions) -> BenchReport``."""


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What the user asked for."""

    seed: int | None = None
    """Fresh scenes drawn from this seed; None: the named ones."""
    out: Path = Path("bench")
    """Folder for intermediate results that a later call resumes from."""
    data: Path = field(default_factory=lambda: Path(os.environ.get("TREEDOCK_DATA", "../shared/data")))
    """Folder of the real recordings."""
    scenes: tuple[str, ...] = ()
    """Names of scenes to do; empty: all."""
    count: int | None = None
    """How many runs, for benchmarks that fly or draw as many as wanted."""
    minutes: float | None = None
    """How long, for benchmarks that go on for as long as wanted (soak)."""
    rendered: bool = False
    """With rendered images and real processes, where a benchmark can do without (missions)."""
    quick: bool = False
    """Less data, for a look; figures then say less."""
    doc: Path | None = None
    """The Markdown file that will show the result: pictures go into ``images`` beside it, else into ``out``."""
    keep_sequences: bool = False
    """Keep what was rendered, for the next call with the same simulator (150 MB a scene)."""
    tell: Callable[[str], None] = lambda _: None
    """Progress, one line at a time."""


@dataclass(frozen=True, slots=True)
class BenchReport:
    """What came out."""

    figures: Mapping[str, float]
    conditions: Mapping[str, str]
    """Sensor, disparity noise s, seeds ...; the machine is added by ``machine``."""
    table: str
    """The result as a Markdown table with whatever explains it."""


def load_bench(name: str) -> Callable[[BenchOptions], BenchReport]:
    """Return a benchmark's function.

    Raises:
        InputError: no such benchmark.
    """
    present = [known for known, module in BENCHES.items() if find_spec(module) is not None]
    if name not in present:
        raise InputError(f"benchmark {name!r}: expected one of {', '.join(present)}")
    run: Callable[[BenchOptions], BenchReport] = importlib.import_module(BENCHES[name]).run
    return run


def machine() -> str:
    """Return a line on the machine the figures were measured on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        model = names[0] if names else model
    return f"{model}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, Python {platform.python_version()}"


def code_version(names: tuple[str, ...]) -> str:
    """Return a hash over the source files of packages and modules (dotted names).

    Results of other code are not reused.
    """
    digest = hashlib.sha256()
    for name in names:
        spec = find_spec(name)
        if spec is None or spec.origin is None:
            continue
        folders = [Path(folder) for folder in spec.submodule_search_locations or ()]
        paths = sorted(path for folder in folders for path in folder.rglob("*.py")) or [Path(spec.origin)]
        for path in paths:
            digest.update(f"{name}/{path.name}".encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def replace_section(text: str, name: str, section: str) -> str:
    """Return a Markdown document with its section ``## name`` replaced, or added at the end."""
    lines = text.splitlines()
    head = f"## {name}"
    body = [head, "", *section.strip().splitlines(), ""]
    if head not in lines:
        return "\n".join([*lines, *([""] if lines and lines[-1] else []), *body]).rstrip("\n") + "\n"
    start = lines.index(head)
    end = next((i for i in range(start + 1, len(lines)) if lines[i].startswith("## ")), len(lines))
    return "\n".join([*lines[:start], *body, *lines[end:]]).rstrip("\n") + "\n"
