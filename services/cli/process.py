"""``treedock process``: a recording in, trajectory, map and trees out; offline, in lockstep, every frame."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from services.camera.sources import Source
    from services.common.config import TreedockConfig
    from services.evaluate.offline import Counts, OfflineResult


def process(
    sequence: Annotated[Path, typer.Argument(help="TUM RGB-D folder or MCAP recording", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results", show_default=False)],
    *,
    skip_bad_frames: Annotated[
        bool, typer.Option("--skip-bad-frames", help="Go on past frames that cannot be used, and count them")
    ] = False,
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Intrinsics (default: the folder's camera.json)")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", help="Configuration file (TOML)")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the metrics as JSON")] = False,
) -> None:
    """Find the trees in a recording. The same input and configuration give the same bytes."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from services.common.config import load_config

    tree = load_config(config)
    values = process_sequence(sequence, out, tree, camera=camera, skip_bad_frames=skip_bad_frames)
    typer.echo(json.dumps(values) if as_json else _summary(values, out))
    if not values["frames"] or not values["tracked_final"]:
        from services.common.errors import GoalNotReachedError

        raise GoalNotReachedError(f"{sequence}: no frame could be tracked; results without a map are in {out}")


def process_sequence(
    sequence: Path,
    out: Path,
    config: TreedockConfig,
    *,
    camera: Path | None = None,
    skip_bad_frames: bool = False,
    quiet: bool = False,
) -> dict[str, Any]:
    """Run the chain over a recording, write the results into ``out`` and return the metrics.

    Raises:
        InputError: the recording, the configuration or ``out`` cannot be used; ``out`` is then as it was.
    """
    from services.camera.sources import open_recording
    from services.evaluate.atomic import prepare, write_files
    from services.evaluate.offline import run_offline

    prepare(out)
    settings = config.camera
    if camera is not None:
        settings = settings.model_copy(update={"camera_file": str(camera)})
    source = open_recording(sequence, settings)
    _single_threaded()
    with _progress(source, quiet=quiet) as tell:
        result = run_offline(source, config, skip_bad_frames=skip_bad_frames, progress=tell)
    files, values = _files(sequence.name, result)
    write_files(out, files)
    return values


def _single_threaded() -> None:
    """OpenCV's threads would add up in another order each time."""
    import cv2

    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)


def _files(title: str, result: OfflineResult) -> tuple[dict[str, bytes], dict[str, Any]]:
    from services.evaluate import exports
    from services.evaluate.metrics import metrics, metrics_bytes
    from services.evaluate.report import report_bytes

    values = metrics(result)
    files = {
        "trajectory.txt": exports.trajectory_bytes(result.trajectory),
        "trajectory_online.txt": exports.trajectory_bytes(result.online),
        "cloud.ply": exports.ply_bytes(result.points_m, result.rgb),
        "trees.json": exports.trees_json(result.trees, "map"),
        "trees.csv": exports.trees_csv(result.trees),
        "trees.geojson": exports.trees_geojson(result.trees, "map"),
        "targets.jsonl": exports.targets_jsonl(result.targets),
        "metrics.json": metrics_bytes(values),
        "report.html": report_bytes(f"treedock: {title}", values, result.trees, result.trajectory),
    }
    return files, values


@contextmanager
def _progress(source: Source, *, quiet: bool) -> Iterator[Callable[[Counts], None] | None]:
    """Show a bar on stderr when that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if quiet or not console.is_terminal:
        yield None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("frames", total=source.expected)

        def tell(counts: Counts) -> None:
            text = f"tracked {counts.tracked}" + (f", left out {len(counts.skipped)}" if counts.skipped else "")
            bar.update(task, completed=counts.frames + len(counts.skipped), description=text)

        yield tell


def _summary(values: dict[str, Any], out: Path) -> str:
    left_out = f", {values['bad_frames']} left out" if values["bad_frames"] else ""
    frame_ms = values["ms"]["frame"]["median"]
    return (
        f"{values['frames']} frames{left_out}, {values['tracked_final']} tracked, {values['trees']} trees "
        f"({values['trees_suitable']} suitable), {frame_ms:.0f} ms a frame, {values['peak_memory_mb']:.0f} MB: {out}"
    )
