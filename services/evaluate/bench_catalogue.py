"""The catalogue of scenes through the whole chain, counted as the reference counted its twenty scenes."""

from __future__ import annotations

import json
import shutil
import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from services.common.config import TreedockConfig
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.trees import Score, read_trees, read_truth, rmse, score

_SIMULATOR = (
    "services.common.geometry",
    *(f"services.simulator.{name}" for name in (
        "scene", "planting", "catalogue", "meshes", "world", "texture", "render", "sensor", "models", "camera", "path", "truth",
        "write",
    )),
)  # fmt: skip
"""What decides the rendered images: the flying part of the simulator does not."""
_CODE = (
    "schemas", "services.common", "services.camera", "services.slam", "services.mapper", "services.detector", *_SIMULATOR,
    "services.evaluate.offline", "services.evaluate.trees", "services.evaluate.bench_catalogue",
)  # fmt: skip
RATE_HZ = 15.0
FRESH_PER_KIND = 10


def scene_names(options: BenchOptions) -> tuple[str, ...]:
    """Return the scenes to do: those asked for, fresh ones for a seed, else the reference's twenty."""
    from services.simulator.catalogue import MULTI, SINGLE

    if options.scenes:
        return options.scenes
    if options.seed is not None:
        first = options.seed * FRESH_PER_KIND
        return tuple(f"random-{kind}-{first + i}" for kind in ("single", "multi") for i in range(FRESH_PER_KIND))
    return SINGLE + MULTI


def run(options: BenchOptions, config: TreedockConfig | None = None) -> BenchReport:
    """Do the scenes that are not done yet, and report on all of them."""
    config = config or TreedockConfig()
    names = scene_names(options)
    version = code_version(_CODE)
    settings = {"rate_hz": RATE_HZ, "reduced": options.quick, "config": config.model_dump(mode="json"), "code": version}
    done = _read_results(options.out / "catalogue.jsonl")
    rows = []
    for number, name in enumerate(names, start=1):
        key = json.dumps({"scene": name, **settings}, sort_keys=True)
        row = done.get(key)
        if row is None:
            row = run_scene(name, config, options)
            _append(options.out / "catalogue.jsonl", {"key": key, **row})
        options.tell(f"{number}/{len(names)} {line_of(row)}")
        rows.append(row)
    return _report(rows, config, options, version)


def run_scene(name: str, config: TreedockConfig, options: BenchOptions) -> dict[str, Any]:
    """Render a scene, process it, keep the results under ``options.out``, and return its row."""
    from services.evaluate.sequence import process_sequence

    keep = options.out / "scenes" / name
    with _rendered(name, options) as sequence:
        values = process_sequence(sequence, keep, config)
        for extra in ("truth.json", "groundtruth.txt"):
            shutil.copy(sequence / extra, keep / extra)
    result = score(read_trees(keep / "trees.json"), read_truth(keep / "truth.json"))
    return {
        "scene": name,
        **_row(result),
        **_trajectory_error(keep),
        "frames": values["frames"],
        "tracked": values["tracked_final"],
        "process_s": round(values["duration_s"] - values["setup_s"], 1),
        "frame_ms": values["ms"]["frame"]["median"],
        "memory_mb": values["peak_memory_mb"],
    }


@contextmanager
def _rendered(name: str, options: BenchOptions, rate_hz: float = RATE_HZ) -> Iterator[Path]:
    """Give the folder of a scene's sequence: one kept from an earlier call, or rendered now."""
    from services.simulator.catalogue import scene_by_name
    from services.simulator.write import write_sequence

    store = options.out / "sequences"
    kept = store / f"{name}-{'half' if options.quick else 'full'}-{rate_hz:g}-{code_version(_SIMULATOR)}"
    if kept.is_dir():
        yield kept
        return
    store.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{name}-", dir=store) as folder:
        sequence = Path(folder) / name
        noise_seed = zlib.crc32(name.encode())  # each scene its own: one accelerometer bias for all would prove little
        write_sequence(scene_by_name(name), sequence, rate_hz=rate_hz, reduced=options.quick, seed=noise_seed)
        if options.keep_sequences:
            sequence = sequence.rename(kept)
        yield sequence


def _row(result: Score) -> dict[str, Any]:
    return {
        "suitable": result.suitable,
        "found": len(result.matches),
        "centre_errors_m": [round(match.centre_error_m, 4) for match in result.matches],
        "radius_errors_m": [round(match.radius_error_m, 4) for match in result.matches],
        "missed": [_where(t.x_m, t.y_m, t.radius_m) for t in result.missed],
        "hidden": [_where(t.x_m, t.y_m, t.radius_m) for t in result.hidden],
        "false": [_where(t.x_m, t.y_m, t.radius_m) for t in result.false],
    }


def _where(x_m: float, y_m: float, radius_m: float) -> dict[str, float]:
    return {"x_m": round(x_m, 3), "y_m": round(y_m, 3), "radius_m": round(radius_m, 3)}


def _trajectory_error(keep: Path) -> dict[str, float]:
    from services.common.errors import InputError
    from services.evaluate.ate import ate, read_trajectory

    try:
        error = ate(read_trajectory(keep / "trajectory.txt"), read_trajectory(keep / "groundtruth.txt"))
    except InputError:  # too few poses: the row's counts tell it
        return {}
    return {"ate_m": round(error.rmse_m, 4), "rotation_deg_max": round(error.rotation_deg_max, 3)}


def line_of(row: Mapping[str, Any]) -> str:
    """Return a scene's row as one line that names what was missed and what was false."""
    parts = [f"{row['scene']}: {row['found']}/{row['suitable']} found, {len(row['false'])} false"]
    parts += [f"{100 * rmse(row['centre_errors_m']):.1f} cm centre, {100 * rmse(row['radius_errors_m']):.1f} cm radius"]
    parts += [
        f"ATE {100 * row['ate_m']:.1f} cm, {row['rotation_deg_max']:.2f} deg" if "ate_m" in row else "no trajectory"
    ]
    parts += [f"{row['tracked']}/{row['frames']} tracked, {row['process_s']:.0f} s"]
    for what in ("missed", "hidden", "false"):
        parts += [f"{what} ({t['x_m']:+.2f} {t['y_m']:+.2f}) r {100 * t['radius_m']:.1f} cm" for t in row[what]]
    return ", ".join(parts)


def _read_results(path: Path) -> dict[str, dict[str, Any]]:
    """Return the rows by key; a line cut by an interruption is left out, so its scene is done again."""
    rows: dict[str, dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else []:
        try:
            row = json.loads(line)
            rows[row.pop("key")] = row
        except (ValueError, KeyError):
            continue
    return rows


def _append(path: Path, row: Mapping[str, Any]) -> None:
    """Add a row to the file; a line that an interruption cut stays behind."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torn = path.exists() and not path.read_bytes().endswith(b"\n") and path.stat().st_size > 0
    with path.open("a", encoding="utf-8") as stream:
        stream.write(("\n" if torn else "") + json.dumps(row) + "\n")


def _report(
    rows: Sequence[Mapping[str, Any]], config: TreedockConfig, options: BenchOptions, version: str
) -> BenchReport:
    kinds = {"single": [r for r in rows if "single" in r["scene"]], "multi": [r for r in rows if "multi" in r["scene"]]}
    kinds["other"] = [r for r in rows if not any(kind in r["scene"] for kind in ("single", "multi"))]
    table = [
        "| scenes | found | false | missed | hidden | centre RMSE (cm) | radius RMSE (cm) | seconds a scene | ms a frame |",
        "|---|---|---|---|---|---|---|---|---|",
        *(_table_line(f"{len(group)} {kind}", group) for kind, group in kinds.items() if group),
        _table_line(f"{len(rows)} all", rows),
        "",
        *(f"- {line_of(row)}" for row in rows),
    ]
    return BenchReport(
        figures=_figures(rows),
        conditions={
            "sensor": f"simulated RGB-D, 640x480, {RATE_HZ:g} Hz, reference path" + (", rendered at half size" if options.quick else ""),
            "noise": "sigma_z = z^2 s / (f B), s 0.08 px, f 565 px, B 0.070 m, partly fixed pattern, mixed pixels, holes",
            "range": f"{config.camera.min_range_m:g} to {config.camera.max_range_m:g} m",
            "scenes": "fresh, seed " + str(options.seed) if options.seed is not None else "named",
            "found": "axis within 0.30 m at the ground and radius within 0.07 m, suitable trees only",
            "code": version,
        },
        table="\n".join(table),
    )  # fmt: skip


def _figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    return {
        "scenes": len(rows),
        "suitable": sum(row["suitable"] for row in rows),
        "found": sum(row["found"] for row in rows),
        "false": sum(len(row["false"]) for row in rows),
        "missed": sum(len(row["missed"]) for row in rows),
        "centre_rmse_m": round(rmse([e for row in rows for e in row["centre_errors_m"]]), 4),
        "radius_rmse_m": round(rmse([e for row in rows for e in row["radius_errors_m"]]), 4),
    }


def _table_line(what: str, rows: Sequence[Mapping[str, Any]]) -> str:
    f = _figures(rows)
    hidden = sum(len(row["hidden"]) for row in rows)
    seconds = sum(row["process_s"] for row in rows) / len(rows)
    frame_ms = sum(row["frame_ms"] for row in rows) / len(rows)
    return (
        f"| {what} | {f['found']}/{f['suitable']} | {f['false']} | {f['missed']} | {hidden} | {100 * f['centre_rmse_m']:.1f} "
        f"| {100 * f['radius_rmse_m']:.1f} | {seconds:.0f} | {frame_ms:.0f} |"
    )
