"""``treedock detect``: the trees in a point cloud file."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import AsJson, ConfigFile

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from services.detector.config import DetectorConfig
    from services.detector.model import DetectionResult
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
    explain: Annotated[bool, typer.Option("--explain", help="Say why candidates were dropped")] = False,
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
    settings = load_config(config).detector.slicing

    from services.detector.readers import read_cloud
    from services.detector.report import as_tree
    from services.detector.vertical import Vertical, find_vertical
    from services.evaluate.exports import tree_rows, trees_json

    read = read_cloud(cloud)
    vertical = Vertical(direction, "as told") if direction else find_vertical(read.points_m, settings)
    result = _run(method, read.points_m, vertical.up, settings)
    trees = [as_tree(t, i + 1, t.layers) for i, t in enumerate(result.trunks)]
    if out is not None:
        _write(out, trees_json(trees, "input"))
    _tell(result, vertical, read.refused, explain=explain, table=not as_json)
    if as_json:
        body: dict[str, Any] = {"frame": "input", "up": list(vertical.up), "trees": tree_rows(trees)}
        if explain:
            body["dropped"] = [_dropped(result, i) for i in range(len(result.rejections))]
        typer.echo(json.dumps(body))


def _run(
    method: str, points_m: NDArray[np.float64], up: tuple[float, float, float], settings: DetectorConfig
) -> DetectionResult:
    if method == "slicing-reference":
        from services.detector.reference import detect_reference

        return detect_reference(points_m, up)
    if method == "cylinder":
        from services.detector.ransac_cylinder import detect_cylinders

        return detect_cylinders(points_m, up)
    from services.detector.detect import detect_trees

    return detect_trees(points_m, up, None, settings)


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


def _tell(result: DetectionResult, vertical: Vertical, refused: int, *, explain: bool, table: bool) -> None:
    """Print the table to stdout (unless JSON goes there), everything else to stderr."""
    from rich.console import Console

    notes = Console(stderr=True, highlight=False, soft_wrap=True)
    up = ",".join(f"{v:g}" for v in (round(c, 4) for c in vertical.up))
    notes.print(f"vertical {up} ({vertical.how}); {result.ground.note}")
    if refused:
        notes.print(f"{refused} points were refused: not finite")
    if table:
        from services.cli.detect_table import trunk_table

        typer.echo(trunk_table(result.trunks, result.points))
    if explain:
        _explain(result, notes)


def _explain(result: DetectionResult, notes: Any) -> None:  # noqa: ANN401 - rich is imported late
    notes.print(f"{len(result.rejections)} candidates dropped" + (":" if result.rejections else ""))
    for r in result.rejections:
        notes.print(
            f"  ({r.x_m:.2f}, {r.y_m:.2f}, {r.z_m:.2f}) radius {r.radius_m:.3f} m, {r.layers} slices: {r.reason}"
        )
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in result.stages_ms.items())
    notes.print(f"ms: {stages}")
