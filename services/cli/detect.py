"""``treedock detect``: the trees in a point cloud file."""

from __future__ import annotations

import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import AsJson, ConfigFile

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from services.detector.config import DetectorConfig
    from services.detector.model import DetectionResult
    from services.detector.readers import Cloud
    from services.detector.units import Unit
    from services.detector.vertical import Vertical

METHODS = ("slicing", "slicing-reference", "cylinder")


def detect(
    cloud: Annotated[Path, typer.Argument(help="Point cloud: ply, pcd, las, laz or xyz", show_default=False)],
    *,
    out: Annotated[Path | None, typer.Option("--out", help="Write trees.json here", show_default=False)] = None,
    method: Annotated[str, typer.Option("--method", help=f"One of: {', '.join(METHODS)}")] = "slicing",
    up: Annotated[
        str | None, typer.Option("--up", help="The vertical, as x,y,z (default: found)", show_default=False)
    ] = None,
    units: Annotated[str, typer.Option("--units", help="Of the coordinates: auto, m, cm, mm or ft")] = "auto",
    explain: Annotated[bool, typer.Option("--explain", help="Say why candidates were dropped")] = False,
    pictures: Annotated[
        Path | None, typer.Option("--pictures", help="Folder for a picture of each candidate", show_default=False)
    ] = None,
    export_trees: Annotated[
        Path | None,
        typer.Option("--export-trees", help="Folder for each tree with its ground, as LAZ", show_default=False),
    ] = None,
    as_json: AsJson = False,
    config: ConfigFile = None,
) -> None:
    """Find the trees in a point cloud. No trees is a result, not an error."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from services.common.config import load_config
    from services.common.errors import InputError

    if method not in METHODS:
        raise InputError(f"--method {method}: unknown; one of {', '.join(METHODS)}")
    direction = _parse_up(up)
    _check_writable(out)
    # the answer is in the cloud's own frame, whatever that frame's error
    settings = load_config(config).detector.slicing.model_copy(update={"map_drift_m": 0.0})

    _check_folders({"--pictures": pictures, "--export-trees": export_trees})
    from services.detector.readers import read_cloud
    from services.detector.report import as_tree
    from services.evaluate.exports import tree_rows, trees_json

    read, vertical, unit_note = _oriented(read_cloud(cloud), direction, _parse_units(units), settings)
    result = _run(method, read, vertical.up, settings)
    trees = [as_tree(t, i + 1, t.layers) for i, t in enumerate(result.trunks)]
    if out is not None:
        _write(out, trees_json(trees, "input"))
    notes = [note for note in (unit_note, *_extras(read.points_m, result, pictures, export_trees)) if note]
    _tell(result, vertical, read.refused, notes, explain=explain, table=not as_json)
    if as_json:
        body: dict[str, Any] = {"frame": "input", "up": list(vertical.up), "trees": tree_rows(trees)}
        if unit_note:
            body["note"] = unit_note
        if explain:
            body["dropped"] = [_dropped(result, i) for i in range(len(result.rejections))]
        typer.echo(json.dumps(body))


def _oriented(
    read: Cloud, direction: tuple[float, float, float] | None, unit: Unit | None, settings: DetectorConfig
) -> tuple[Cloud, Vertical, str]:
    """Return the cloud in metres, its vertical, and a line on its unit (empty for plain metres)."""
    from services.detector.units import METRES, NAMES, find_unit
    from services.detector.vertical import Vertical, find_vertical

    if read.views is not None and direction is None and unit in (None, "m"):
        return read, Vertical((0.0, 0.0, 1.0), "as treedock wrote it"), ""
    if unit is None and direction is None:
        found = find_unit(read.points_m, settings)
        return _in_metres(read, METRES[found.unit]), found.vertical, found.note
    read = _in_metres(read, METRES[unit or "m"])
    vertical = Vertical(direction, "as told") if direction is not None else find_vertical(read.points_m, settings)
    return read, vertical, f"read as {NAMES[unit]}, as told" if unit not in (None, "m") else ""


def _in_metres(read: Cloud, scale: float) -> Cloud:
    return read if scale == 1.0 else replace(read, points_m=read.points_m * scale, views=None)


def _extras(
    points_m: NDArray[np.float64], result: DetectionResult, pictures: Path | None, export: Path | None
) -> list[str]:
    """Write what else was asked for; return what to say about it."""
    said = []
    if export is not None:
        from services.cli.detect_export import export_trees

        said.append(f"{len(export_trees(export, points_m, result))} trees written to {export}")
    if pictures is not None:
        from services.cli.detect_pictures import draw_candidates

        said.append(f"{len(draw_candidates(pictures, points_m, result))} pictures written to {pictures}")
    return said


def _run(method: str, read: Cloud, up: tuple[float, float, float], settings: DetectorConfig) -> DetectionResult:
    if method == "slicing-reference":
        from services.detector.reference import detect_reference

        return detect_reference(read.points_m, up)
    if method == "cylinder":
        from services.detector.ransac_cylinder import detect_cylinders

        return detect_cylinders(read.points_m, up)
    from services.detector.detect import detect_trees

    return detect_trees(read.points_m, up, read.views, settings)


def _parse_up(text: str | None) -> tuple[float, float, float] | None:
    from services.common.errors import InputError

    if text is None:
        return None
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--up {text}: three numbers x,y,z were expected, for example 0,0,1") from None
    if not 1e-6 < x * x + y * y + z * z < 1e12:
        raise InputError(f"--up {text}: the length of this direction is zero or not finite")
    return x, y, z


def _parse_units(text: str) -> Unit | None:
    from services.common.errors import InputError
    from services.detector.units import UNITS

    if text == "auto":
        return None
    for unit in UNITS:
        if text == unit:
            return unit
    raise InputError(f"--units {text}: unknown; one of auto, {', '.join(UNITS)}")


def _check_folders(folders: dict[str, Path | None]) -> None:
    """Refuse, before the long work, a folder that is a file or cannot be made."""
    from services.common.errors import InputError

    for option, folder in folders.items():
        if folder is None:
            continue
        if folder.exists() and not folder.is_dir():
            raise InputError(f"{option} {folder}: is a file, the name of a folder was expected")
        nearest = folder.absolute()
        while not nearest.exists():
            nearest = nearest.parent
        if not os.access(nearest, os.W_OK | os.X_OK):
            raise InputError(f"{option} {folder}: this user may not write there")


def _check_writable(out: Path | None) -> None:
    from services.common.errors import InputError

    if out is None:
        return
    folder = out.absolute().parent
    try:
        if out.is_dir():
            raise InputError(f"--out {out}: is a folder, the name of a file was expected")
        if not folder.is_dir():
            raise InputError(f"--out {out}: the folder {folder} does not exist")
        if not os.access(out if out.exists() else folder, os.W_OK):
            raise InputError(f"--out {out}: this user may not write there")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from None


def _write(out: Path, data: bytes) -> None:
    """Write the whole file or nothing; a device or a pipe (/dev/null, /dev/stdout) is written to, never replaced."""
    from services.common.errors import InputError

    out = out.resolve() if out.is_file() or not out.exists() else out
    device = out.exists() and not out.is_file()
    partial = out if device else out.with_name(f".{os.getpid()}.partial")
    try:
        with partial.open("wb") as stream:
            stream.write(data)
            if not device:
                stream.flush()
                os.fsync(stream.fileno())
        if not device:
            partial.replace(out)
    except OSError as error:
        if not device:
            partial.unlink(missing_ok=True)
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from error


def _dropped(result: DetectionResult, index: int) -> dict[str, Any]:
    r = result.rejections[index]
    return {
        "x_m": round(r.x_m, 3), "y_m": round(r.y_m, 3), "z_m": round(r.z_m, 3), "radius_m": round(r.radius_m, 4),
        "layers": r.layers, "reason": r.reason,
    }  # fmt: skip


def _tell(
    result: DetectionResult, vertical: Vertical, refused: int, said: list[str], *, explain: bool, table: bool
) -> None:
    """Print the table to stdout (unless JSON goes there), everything else to stderr."""
    from rich.console import Console

    notes = Console(stderr=True, highlight=False, soft_wrap=True)
    up = ",".join(f"{v:g}" for v in (round(c, 4) for c in vertical.up))
    notes.print(f"vertical {up} ({vertical.how}); {result.ground.note}")
    for line in said:
        notes.print(line)
    if refused:
        notes.print(f"{refused} points were refused: not finite")
    if table:
        from services.cli.detect_table import trunk_table

        typer.echo(trunk_table(result.trunks, result.points))
    if explain:
        _explain(result, notes)
    elif not result.trunks:
        notes.print(_why_none(result))


def _why_none(result: DetectionResult) -> str:
    """Return in one line what became of the candidates."""
    if not result.rejections:
        return "no candidates: no slices with arcs of a circle above each other"
    kinds = Counter(r.reason.rpartition(": ")[2] if ": " in r.reason else r.reason for r in result.rejections)
    few = ", ".join(f"{reason} ({count})" for reason, count in kinds.most_common(4))
    return f"{len(result.rejections)} candidates dropped: {few}; --explain tells each"


def _explain(result: DetectionResult, notes: Any) -> None:  # noqa: ANN401 - rich is imported late
    notes.print(f"{len(result.rejections)} candidates dropped" + (":" if result.rejections else ""))
    for r in result.rejections:
        notes.print(
            f"  ({r.x_m:.2f}, {r.y_m:.2f}, {r.z_m:.2f}) radius {r.radius_m:.3f} m, {r.layers} slices: {r.reason}"
        )
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in result.stages_ms.items())
    notes.print(f"ms: {stages}")
