"""``treedock record``: everything worth keeping of a running system, into MCAP files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import ConfigFile, Port, Settings


def record(
    *,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the files (default: recordings).")] = None,
    frames: Annotated[
        str | None, typer.Option("--frames", help="Camera frames: compressed, raw or off.", metavar="HOW")
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> int:
    """Record until Ctrl-C. Foxglove opens the files as they are; `process` and `replay` take them."""
    from services.cli.service_command import run_by_name

    more = {}
    if out is not None:
        more["recorder.folder"] = str(out)
    if frames is not None:
        more["recorder.frames"] = frames
    return run_by_name("recorder", config, settings, port, more)
