"""``treedock simulate``: a simulated flight as a TUM RGB-D folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer


def simulate(
    scene: Annotated[str, typer.Argument(help="multi-03, hard-slope-1, random-mission-7 ... (see --list)")] = "",
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write", show_default=False)] = None,
    *,
    rate_hz: Annotated[float, typer.Option("--rate", help="Frames per second", min=1.0, max=60.0)] = 15.0,
    reduced: Annotated[bool, typer.Option("--reduced", help="Render 320x240 and scale up: 3 times as fast")] = False,
    frames: Annotated[int | None, typer.Option("--frames", help="Stop after so many", min=1)] = None,
    turn_rate_deg_s: Annotated[float, typer.Option("--turn-rate", help="Degrees per second", min=1.0, max=90.0)] = 30.0,
    seed: Annotated[int, typer.Option("--seed", help="Draws the sensor's noise", min=0)] = 0,
    list_scenes: Annotated[bool, typer.Option("--list", help="List the scenes and stop")] = False,
) -> None:
    """Fly the scripted path through a simulated forest and write what the camera saw, with the truth beside it."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from services.common.errors import InputError
    from services.simulator.catalogue import CATALOGUE, KINDS, scene_by_name

    if list_scenes:
        typer.echo("\n".join([*CATALOGUE, *(f"random-{kind}-SEED[-TREES]" for kind in KINDS)]))
        return
    if not scene:
        raise InputError("simulate needs a scene: name one of those that `treedock simulate --list` shows")
    if out is None:
        raise InputError("simulate needs a folder to write to: add --out DIR")
    place = scene_by_name(scene)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: exists and is not an empty folder; name another one")
    count = _write(place.name, out, rate_hz, reduced, frames, turn_rate_deg_s, seed)
    typer.echo(f"{count} frames of {place.name} in {out}")


def _write(
    scene: str, out: Path, rate_hz: float, reduced: bool, frames: int | None, turn_rate_deg_s: float, seed: int
) -> int:
    import math

    import cv2
    from rich.console import Console
    from rich.progress import Progress

    from services.simulator.catalogue import scene_by_name
    from services.simulator.config import PathConfig
    from services.simulator.write import write_sequence

    cv2.setNumThreads(1)
    path = PathConfig(turn_rate_rad_s=math.radians(turn_rate_deg_s))
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task(scene, total=frames)
        return write_sequence(
            scene_by_name(scene), out, rate_hz, reduced, frames, seed, path,
            progress=lambda done, total: bar.update(task, completed=done, total=total),
        )  # fmt: skip
