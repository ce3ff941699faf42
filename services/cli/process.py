"""``treedock process``: a recording in, trajectory, map and trees out; offline, in lockstep, every frame."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import AsJson, ConfigFile, Settings, loaded
from services.common.words import plural

if TYPE_CHECKING:
    from rich.progress import TaskID

    from services.camera.sources import Source
    from services.evaluate.offline import Counts
    from services.evaluate.sequence import FineProgress, Progress


def process(
    sequence: Annotated[Path, typer.Argument(help="TUM RGB-D folder, MCAP recording or ROS bag", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder for the results", show_default=False)],
    *,
    skip_bad_frames: Annotated[
        bool, typer.Option("--skip-bad-frames", help="Go on past frames that cannot be used, and count them")
    ] = False,
    camera: Annotated[
        Path | None, typer.Option("--camera", help="Intrinsics (default: the folder's camera.json)")
    ] = None,
    fine: Annotated[
        bool, typer.Option("--fine", help="Also make a finer map of all frames, and measure diameters along each stem")
    ] = False,
    config: ConfigFile = None,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Find the trees in a recording (--json prints the metrics). The same input and configuration give the same bytes."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from services.evaluate.sequence import process_sequence

    tree = loaded(config, settings, None).config
    with _progress() as (tell, tell_fine):
        values = process_sequence(
            sequence,
            out,
            tree,
            camera=camera,
            skip_bad_frames=skip_bad_frames,
            fine=fine,
            progress=tell,
            fine_progress=tell_fine,
        )
    if values["source_note"]:
        typer.echo(f"treedock: {sequence}: {values['source_note']}", err=True)
    typer.echo(json.dumps(values) if as_json else _summary(values, out))
    if not values["frames"] or not values["tracked_final"]:
        from services.common.errors import GoalNotReachedError

        raise GoalNotReachedError(f"{sequence}: no frame could be tracked; results without a map are in {out}")


@contextmanager
def _progress() -> Iterator[tuple[Progress | None, FineProgress | None]]:
    """Show a bar on stderr when that is a terminal, and a second one for the finer map."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None, None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("frames", total=None)

        def tell(counts: Counts, source: Source) -> None:
            text = f"tracked {counts.tracked}" + (f", left out {len(counts.skipped)}" if counts.skipped else "")
            done = counts.frames + len(counts.skipped)
            bar.update(task, completed=done, total=source.expected, description=text)

        again: list[TaskID] = []

        def tell_fine(done: int, whole: int) -> None:
            if not again:
                again.append(bar.add_task("finer map", total=whole))
            bar.update(again[0], completed=done)

        yield tell, tell_fine


def _summary(values: dict[str, Any], out: Path) -> str:
    left_out = f", {values['bad_frames']} left out" if values["bad_frames"] else ""
    frame_ms = values["ms"]["frame"]["median"]
    finer = f", {values['fine']['stems']} stems measured" if "fine" in values else ""
    return (
        f"{values['frames']} {plural(values['frames'], 'frame')}{left_out}, {values['tracked_final']} tracked, {values['trees']} {plural(values['trees'], 'tree')} "
        f"({values['trees_suitable']} suitable){finer}, {frame_ms:.0f} ms a frame, {values['peak_memory_mb']:.0f} MB: {out}"
    )
