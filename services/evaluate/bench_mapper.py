"""The mapper by itself: rings after a turn, ground, memory and time over a long walk, and the saved map."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.ring import Ring
from services.evaluate.ring_turns import TurnResult, turns
from services.evaluate.ring_walk import WalkResult, walk

SEEDS = (61, 62, 63)
"""41 to 43 were looked at while the mapper was made."""
_KINDS = ("multi", "slope", "undergrowth")
_SHORT = 60
_TIMES = 10


def scene_names(options: BenchOptions) -> tuple[str, ...]:
    """Return the scenes of the turns: those asked for, or one of each kind from the seed."""
    if options.scenes:
        return options.scenes
    seeds = SEEDS if options.seed is None else tuple(options.seed * len(_KINDS) + k for k in range(len(_KINDS)))
    names = tuple(f"random-{kind}-{seed}" for kind, seed in zip(_KINDS, seeds, strict=True))
    return names[:1] if options.quick else names


def run(options: BenchOptions) -> BenchReport:
    """Measure rings, ground, memory and the saved map."""
    names = scene_names(options)
    done = turns(names, options)
    short, again = walk(_SHORT), walk(_SHORT, rounds=3)
    options.tell(f"walk of {_SHORT} keyframes done, and three times over the same ground")
    long = walk(_SHORT * (2 if options.quick else _TIMES))
    saved = _saved(long)
    figures, tables = _figures(done, short, again, long), _tables(done, short, again, long)
    figures.update(saved)
    tables += ["", f"A map of {long.points} points is {saved['file_mb']:.1f} MB on disk, written in {saved['save_ms']:.0f} ms (with fsync, in a thread of its own), read and checked in {saved['load_ms']:.0f} ms."]  # fmt: skip
    return BenchReport(
        figures=figures,
        conditions={
            "turns": f"simulated 360 deg at 30 deg/s, 640x480 rendered at half size, s 0.08 px; scenes {', '.join(names)}; slam's own poses",
            "ring": "suitable trees that could be seen, points 1.0 to 1.6 m above the foot about the fitted centre; thickness: half the width of the middle 68 %; doubled: share on a second surface; apart: RMS between single keyframes on the same 10 degrees of bark",
            "walk": f"synthetic plantation, 320x240, a keyframe each 0.5 m, rows 5 m apart, a graph of all keyframes after each; {short.keyframes} and {long.keyframes} keyframes",
            "bytes": "points, colours, their voxels and the voxel table; the ground grid's fixed 4 MB apart",
        },
        table="\n".join(tables),
    )  # fmt: skip


def _select(done: Sequence[TurnResult], *, loop_closing: bool, register: bool) -> list[TurnResult]:
    return [r for r in done if r.loop_closing is loop_closing and r.register is register]


def _mean(rings: Sequence[Ring], value: Callable[[Ring], float]) -> float:
    values = [v for v in map(value, rings) if np.isfinite(v)]
    return float(np.mean(values)) if values else float("nan")


def _figures(done: Sequence[TurnResult], short: WalkResult, again: WalkResult, long: WalkResult) -> dict[str, float]:
    figures: dict[str, float] = {}
    for name, loop_closing, register in (
        ("", True, False), ("_open", False, False), ("_registered", True, True), ("_open_registered", False, True),
    ):  # fmt: skip
        rings = [ring for r in _select(done, loop_closing=loop_closing, register=register) for ring in r.rings]
        figures[f"ring_thickness{name}_m"] = round(_mean(rings, lambda r: r.thickness_m), 4)
        figures[f"ring_apart{name}_m"] = round(_mean(rings, lambda r: r.view_spread_m), 4)
        figures[f"ring_doubled{name}"] = round(_mean(rings, lambda r: r.doubled_share), 3)
    main = _select(done, loop_closing=True, register=False)
    figures["rings"] = sum(len(r.rings) for r in main)
    figures["ground_rmse_m"] = round(float(np.sqrt(np.mean([r.ground.rmse_m**2 for r in main]))), 4)
    figures["ground_slope_deg"] = round(float(np.sqrt(np.mean([r.ground.slope_deg**2 for r in main]))), 2)
    figures |= {
        "bytes_per_m2": round(long.nbytes / long.area_m2),
        "bytes_per_m2_short": round(short.nbytes / short.area_m2),
        "points_per_m2": round(long.points / long.area_m2),
        "memory_times_three_rounds": round(again.nbytes / short.nbytes, 2),
        "keyframe_ms_short": round(_settled_ms(short), 1),
        "keyframe_ms_long_end": round(float(np.median(long.keyframe_ms[-_SHORT:])), 1),
        "keyframe_ms_long_max": round(float(long.keyframe_ms[5:].max()), 1),
    }
    return figures


def _settled_ms(w: WalkResult) -> float:
    return float(np.median(w.keyframe_ms[len(w.keyframe_ms) // 3 :]))


def _tables(done: Sequence[TurnResult], short: WalkResult, again: WalkResult, long: WalkResult) -> list[str]:
    rows = [
        "| scene | loops | registration | rings | thickness (cm) | apart (cm) | doubled (%) | points | moved by registration | ms a keyframe |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in done:
        ms = sum(r.stage_ms.get(stage, 0.0) for stage in ("cloud", "register", "insert"))
        rows.append(
            f"| {r.scene} | {'closed' if r.loop_closing else 'open'} | {'on' if r.register else 'off'} | {len(r.rings)} "
            f"| {100 * _mean(r.rings, lambda g: g.thickness_m):.2f} | {100 * _mean(r.rings, lambda g: g.view_spread_m):.2f} "
            f"| {100 * _mean(r.rings, lambda g: g.doubled_share):.1f} | {r.points} "
            f"| {f'{r.accepted} of {r.accepted + r.refused}' if r.register else ''} | {ms:.0f} |"
        )
    rows += ["", "| ground | cells | bias (cm) | RMSE (cm) | slope RMSE (deg) |", "|---|---|---|---|---|"]
    rows += [
        f"| {r.scene} | {r.ground.cells} | {100 * r.ground.bias_m:.1f} | {100 * r.ground.rmse_m:.1f} | {r.ground.slope_deg:.1f} |"
        for r in _select(done, loop_closing=True, register=False)
    ]
    rows += ["", "| walk | keyframes | area (m2) | points | MB | bytes a m2 | ms a keyframe, median of the last |", "|---|---|---|---|---|---|---|"]  # fmt: skip
    rows += [
        f"| {name} | {w.keyframes} | {w.area_m2:.0f} | {w.points} | {w.nbytes / 1e6:.1f} | {w.nbytes / w.area_m2:.0f} | {np.median(w.keyframe_ms[-_SHORT // 2 :]):.1f} |"
        for name, w in (("short", short), ("the same ground three times", again), (f"{len(long.keyframe_ms) // _SHORT} times as long", long))
    ]  # fmt: skip
    return rows


def _saved(long: WalkResult) -> dict[str, float]:
    """Write and read a map of the size that the long walk made."""
    from services.common.files import write_parts
    from services.mapper.dense_map import MapSubmap
    from services.mapper.saved_map import SavedMap, pack, unpack

    rng, each = np.random.default_rng(0), max(1, long.points // long.keyframes)
    submaps = [
        MapSubmap(k, k, rng.random((each, 3), dtype=np.float32), np.zeros((each, 3), dtype=np.uint8), np.eye(4), anchor_id=k)
        for k in range(long.keyframes)
    ]  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="treedock-map-") as folder:
        file = Path(folder) / "map.tdmap"
        begin = time.perf_counter()
        write_parts(file, pack(SavedMap("m", 1, submaps)))
        middle = time.perf_counter()
        unpack(file.read_bytes())
        end = time.perf_counter()
        size = file.stat().st_size
    return {
        "file_mb": round(size / 1e6, 1), "save_ms": round(1e3 * (middle - begin), 1),
        "load_ms": round(1e3 * (end - middle), 1),
    }  # fmt: skip
