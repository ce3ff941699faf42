"""``treedock recordings``: what lies in a folder of recordings; ``--recover`` mends those that were cut."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import AsJson, ConfigFile, Settings, loaded

if TYPE_CHECKING:
    from services.recorder.index import Run


def recordings(
    folder: Annotated[
        Path | None, typer.Argument(help="Folder of recordings (default: the configured recorder.folder).")
    ] = None,
    *,
    recover: Annotated[bool, typer.Option("--recover", help="Mend files that were cut short.")] = False,
    as_json: AsJson = False,
    config: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """List recordings: when, how long, how big, frames and versions of the trees in them."""
    from services.recorder.index import index
    from services.recorder.recover import recover_folder

    folder = folder or loaded(config, settings, None).config.recorder.folder
    found = index(folder)
    if recover:
        for mended in recover_folder(folder):
            typer.echo(str(mended), err=True)
        found = index(folder)
    if as_json:
        typer.echo(json.dumps([_values(run) for run in found]))
        return
    if not found:
        typer.echo(f"no recording in {folder}; `treedock record --out {folder}` makes one")
    for run in found:
        typer.echo(_line(run))


def _values(run: Run) -> dict[str, object]:
    return {
        "file": str(run.path), "bytes": run.bytes, "whole": run.whole, "begun_ns": run.begun_ns,
        "seconds": round(run.seconds, 3), "messages": dict(run.counts), "about": dict(run.about),
    }  # fmt: skip


def _line(run: Run) -> str:
    size = f"{run.bytes / 1e6:.1f} MB"
    if not run.whole:
        return f"{run.path.name}  {size:>10}  cut short or being written: --recover mends what nobody writes"
    frames = run.count("camera/rgbd_compressed") + run.count("camera/rgbd")
    begun = dict(run.about).get("begun_utc", "")
    return f"{run.path.name}  {size:>10}  {run.seconds:7.1f} s  {frames:6d} frames  {run.count('trees/list'):4d} versions of the trees  {begun}"
