"""dendromatics and treeX against ours: the same clouds, the same run, the peers in an environment of their own.

Where that environment cannot be made nothing is measured, and the figures say nothing: never a false one.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.common.errors import GoalNotReachedError
from services.detector.model import Views
from services.evaluate.bench import BenchOptions, BenchReport, code_version

Floats = NDArray[np.float64]

PACKAGES = {"dendromatics": "dendromatics==0.7.0", "treex": "pointtree==1.0.1"}
"""Peer -> what pip installs; no address: pip's own configuration says where from."""
OURS = ("treedock", "treedock_points")
"""With the view rays of our own maps, as they are used; and from the points alone, which is what the peers get."""
METHODS = (*OURS, *PACKAGES)
_OURS, _THEIRS = ("services.detector", "services.evaluate.bench_peers"), "services.evaluate.peer_driver"
_DRIVER = Path(__file__).with_name("peer_driver.py")
_INSTALL_S = 900.0
_CLOUD_S = 420.0
_WITHIN_M = 0.30
_RADIUS_WITHIN_M = 0.07
SEEDS = (61, 62, 63)
_KINDS = ("multi", "slope", "undergrowth")

Stem = tuple[float, float, float]
"""x, y at breast height, radius; NaN where it is not known."""


@dataclass(frozen=True, slots=True)
class PeerCloud:
    """A cloud with z up and the stems that stand in it."""

    name: str
    points_m: Floats = field(repr=False)
    stems: tuple[Stem, ...]
    views: Views | None = field(default=None, repr=False)
    """From where our own maps saw their points; no peer can use it."""
    groundless: bool = False
    """The cloud holds stems only: the peers, who need ground, get a flat sheet of it under the lowest point."""
    ignored: tuple[Stem, ...] = ()
    """Real, but not fair to ask for (cut by the border, hidden, too thick): neither found nor false."""


@dataclass(frozen=True, slots=True)
class PeerScore:
    """What one method made of one cloud."""

    method: str
    cloud: str
    stems: int
    found: int
    false: int
    centre_m: tuple[float, ...]
    radius_m: tuple[float, ...]
    seconds: float
    """Of a warm call."""
    fault: str = ""
    settings: str = ""
    """Of a peer: those of its settings that found most, less what is false."""


@dataclass(frozen=True, slots=True)
class Run:
    """What one call gave."""

    stems: tuple[Stem, ...]
    seconds: float
    fault: str = ""
    settings: str = ""


def run(options: BenchOptions) -> BenchReport:
    """Run all methods on all clouds.

    Raises:
        GoalNotReachedError: the peers' environment cannot be made: not measured.
    """
    python = environment(options)
    clouds = list(_clouds(options))
    scores = []
    for cloud in clouds:
        for method in METHODS:
            score = _done_before(method, cloud, python, options)
            options.tell(_line(score))
            scores.append(score)
    return _report(scores, clouds, options)


def _done_before(method: str, cloud: PeerCloud, python: Path, options: BenchOptions) -> PeerScore:
    """Return a score kept by an earlier call with the same code and cloud, or measure it now and keep it."""
    digest = hashlib.sha256(np.ascontiguousarray(cloud.points_m).tobytes() + repr(cloud.stems).encode())
    code = code_version(_OURS if method in OURS else (_THEIRS,))
    kept = options.out / "peers" / f"{cloud.name}-{method}-{digest.hexdigest()[:8]}-{code[:8]}.json"
    if kept.exists():
        body: dict[str, Any] = json.loads(kept.read_text())
        body |= {name: tuple(body[name]) for name in ("centre_m", "radius_m")}
        return PeerScore(**body)
    score = _score(method, cloud, python)
    kept.parent.mkdir(parents=True, exist_ok=True)
    kept.write_text(json.dumps(asdict(score)))
    return score


def environment(options: BenchOptions) -> Path:
    """Return the interpreter of an environment that holds the peers, made with pip on the first call.

    Raises:
        GoalNotReachedError: it cannot be made (no network, no wheel for this machine); pip's last words are given.
    """
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "treedock"
    name = hashlib.sha256(" ".join([*PACKAGES.values(), sys.version]).encode()).hexdigest()[:12]
    folder = cache / f"peers-{name}"
    python = folder / "bin" / "python"
    if (folder / "complete").exists():
        return python
    options.tell(f"making an environment for the peers in {folder} (pip, some 500 MB)")
    try:
        venv.create(folder, with_pip=True, clear=True)
        command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *PACKAGES.values()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=_INSTALL_S, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        raise GoalNotReachedError(f"not measured: the peers' environment {folder} cannot be made: {error}") from None
    if done.returncode != 0:
        words = done.stderr.strip().splitlines()
        last = next((line for line in reversed(words) if line.startswith("ERROR")), words[-1] if words else "no word")
        raise GoalNotReachedError(f"not measured: pip cannot install {', '.join(PACKAGES.values())}: {last}")
    (folder / "complete").touch()
    return python


def match(found: Sequence[Stem], cloud: PeerCloud) -> tuple[list[tuple[Stem, Stem]], int]:
    """Return pairs (true, found), nearest first, each used once, and how many of the found stand for nothing.

    Found: within 0.30 m, and the radius within 0.07 m where it is known. A second stem at a true one is false.
    """
    pairs = sorted(
        (_apart(true, stem), i, k)
        for i, true in enumerate(cloud.stems)
        for k, stem in enumerate(found)
        if _apart(true, stem) <= _WITHIN_M and not abs(true[2] - stem[2]) > _RADIUS_WITHIN_M
    )
    taken: dict[int, int] = {}
    for _, i, k in pairs:
        if i not in taken and k not in taken.values():
            taken[i] = k
    rest = [stem for k, stem in enumerate(found) if k not in taken.values()]
    false = [s for s in rest if all(_apart(s, other) > _WITHIN_M + max(0.0, np.nan_to_num(other[2])) for other in cloud.ignored)]  # fmt: skip
    return [(cloud.stems[i], found[k]) for i, k in sorted(taken.items())], len(false)


def _apart(a: Stem, b: Stem) -> float:
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def _score(method: str, cloud: PeerCloud, python: Path) -> PeerScore:
    if method in OURS:
        return _scored(method, cloud, _ours(cloud.points_m, cloud.views if method == OURS[0] else None))
    runs = [_scored(method, cloud, run) for run in _theirs(method, with_sheet(cloud), python)]
    return max(runs, key=lambda s: (s.found - s.false, -len(s.fault)))


def _scored(method: str, cloud: PeerCloud, run: Run) -> PeerScore:
    pairs, false = match(run.stems, cloud)
    known = [(t, f) for t, f in pairs if np.isfinite(t[2])]
    return PeerScore(
        method=method, cloud=cloud.name, stems=len(cloud.stems), found=len(pairs), false=false,
        centre_m=tuple(_apart(t, f) for t, f in known), radius_m=tuple(f[2] - t[2] for t, f in known),
        seconds=run.seconds, fault=run.fault, settings=run.settings,
    )  # fmt: skip


def _ours(points_m: Floats, views: Views | None) -> Run:
    """Return the stems as `treedock detect` lists them."""
    from services.detector.detect import detect_trees

    for _ in range(2):
        begin = time.perf_counter()
        result = detect_trees(points_m, (0.0, 0.0, 1.0), views)
        seconds = time.perf_counter() - begin
    stems = []
    for t in result.trunks:
        rise = 1.3 / max(t.axis[2], 0.5)
        stems.append((t.base_m[0] + rise * t.axis[0], t.base_m[1] + rise * t.axis[1], t.radius_m))
    return Run(tuple(stems), seconds)


def with_sheet(cloud: PeerCloud) -> Floats:
    """Return the cloud, with ground added where it has none: a point each 5 cm, rough by 1 cm."""
    if not cloud.groundless:
        return cloud.points_m
    low, high = cloud.points_m.min(axis=0), cloud.points_m.max(axis=0)
    x, y = np.meshgrid(np.arange(low[0] - 1.0, high[0] + 1.0, 0.05), np.arange(low[1] - 1.0, high[1] + 1.0, 0.05))
    z = low[2] + np.random.default_rng(0).normal(0.0, 0.01, x.size)
    return np.concatenate([cloud.points_m, np.column_stack([x.ravel(), y.ravel(), z])])


def _theirs(method: str, points_m: Floats, python: Path) -> list[Run]:
    """Return what a peer made of a cloud with each of its settings, as far as time allowed."""
    with tempfile.TemporaryDirectory(prefix="treedock-peers-") as folder:
        cloud, out = Path(folder) / "cloud.npz", Path(folder) / "out.json"
        shift = np.floor(points_m.min(axis=0))  # coordinates of a whole country are hard on any method
        np.savez(cloud, points_m=points_m - shift)
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
        command = [str(python), str(_DRIVER), method, str(cloud), str(out)]
        try:
            done = subprocess.run(command, cwd=folder, env={**os.environ, **threads}, capture_output=True, text=True, timeout=_CLOUD_S, check=False)  # fmt: skip
            words = done.stderr.strip().splitlines()
            fault = words[-1] if words else f"ended with {done.returncode}"
        except subprocess.TimeoutExpired:
            fault = f"not done after {_CLOUD_S:.0f} s"
        body = json.loads(out.read_text()) if out.exists() else []
    return [
        Run(tuple((x + shift[0], y + shift[1], r) for x, y, r in b["stems"]), b["seconds"], b["fault"], b["settings"])
        for b in body
    ] or [Run((), float("nan"), fault)]


def _clouds(options: BenchOptions) -> Iterator[PeerCloud]:
    from services.evaluate.peer_clouds import real_clouds, simulated_cloud, whole_cloud

    seeds = SEEDS if options.seed is None else tuple(3 * options.seed + k for k in range(3))
    names = options.scenes or tuple(f"random-{k}-{s}" for k, s in zip(_KINDS, seeds, strict=True))
    for name in names[:1] if options.quick else names:
        yield simulated_cloud(name, options)
        yield whole_cloud(name, options)
    yield from real_clouds(options.data / "clouds", options.tell)


def _line(s: PeerScore) -> str:
    return (
        f"{s.cloud}, {s.method}: {s.found}/{s.stems} found, {s.false} false, centre {_cm(s.centre_m)}, radius {_cm(s.radius_m)} cm, "
        f"{s.seconds:.2f} s{': ' + s.fault if s.fault else ''}"
    )


def _cm(errors: Sequence[float]) -> str:
    return f"{100 * float(np.sqrt(np.mean(np.square(errors)))):.1f}" if errors else "-"


def _totals(scores: Sequence[PeerScore], method: str) -> Mapping[str, float]:
    own = [s for s in scores if s.method == method]
    centre, radius = [e for s in own for e in s.centre_m], [e for s in own for e in s.radius_m]
    figures: dict[str, float] = {
        "stems": sum(s.stems for s in own), "found": sum(s.found for s in own), "false": sum(s.false for s in own),
        "failed": sum(bool(s.fault) for s in own), "seconds": round(float(np.nansum([s.seconds for s in own])), 3),
    }  # fmt: skip
    if centre:
        figures["centre_rmse_m"] = round(float(np.sqrt(np.mean(np.square(centre)))), 4)
        figures["radius_rmse_m"] = round(float(np.sqrt(np.mean(np.square(radius)))), 4)
    return figures


def _report(scores: Sequence[PeerScore], clouds: Sequence[PeerCloud], options: BenchOptions) -> BenchReport:
    methods = METHODS
    rows = [
        "| cloud | points | stems | " + " | ".join(f"{m}: found, false, centre, radius (cm), s" for m in methods) + " |"
    ]
    rows.append("|---" * (3 + len(methods)) + "|")
    for cloud in clouds:
        cells = []
        for method in methods:
            s = next(s for s in scores if s.method == method and s.cloud == cloud.name)
            told = f"{s.found}, {s.false}, {_cm(s.centre_m)}, {_cm(s.radius_m)}, {s.seconds:.2f}"
            told += f"; {s.settings}" if s.settings else ""
            cells.append(f"{told} ({s.fault[:60]})" if s.fault else told)
        rows.append(f"| {cloud.name} | {len(cloud.points_m)} | {len(cloud.stems)} | " + " | ".join(cells) + " |")
    rows.append("")
    figures = {f"{method}_{name}": value for method in methods for name, value in _totals(scores, method).items()}
    return BenchReport(
        figures=figures,
        conditions={
            "peers": f"{', '.join(PACKAGES.values())} in an environment of their own, one thread; dendromatics as 3DFin, its own application, drives it, with 3DFin's defaults and two settings for a camera's clouds; treeX with its author's three presets, crowns included (the one call it has); shown are, cloud by cloud, those settings that found most less false",
            "ours": "treedock: with the view rays that our maps keep; treedock_points: without, as the peers; the same on the recorded clouds, which have none",
            "simulated": "turns on the spot rendered at half size, s 0.08 px, mapped by our own slam and mapper; trees that are suitable and could be seen",
            "whole": "the same scenes rendered at full size, every point of every keyframe at its true pose, nothing thinned: what a peer could ask for",
            "ground": "TreeLS_square and TLS_to_FDS hold stems only; the peers get a flat sheet of ground under them, ours does without",
            "real": "stems confirmed by eye (docs/clouds.md); centre and radius only where taped or simulated",
            "found": "axis within 0.30 m at breast height, radius within 0.07 m where it is known",
            "seconds": "of a warm call with the settings shown",
            "seed": str(options.seed),
        },
        table="\n".join(rows),
    )  # fmt: skip
