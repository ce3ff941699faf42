"""``treedock replay``: a recording back onto the bus, at its own pace or another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.options import ConfigFile, Port, Settings, loaded


def replay(
    file: Annotated[Path, typer.Argument(help="MCAP recording.", show_default=False)],
    *,
    rate: Annotated[float, typer.Option("--rate", min=0.01, max=100.0, help="Speed; 2 is twice as fast.")] = 1.0,
    begin: Annotated[float, typer.Option("--from", min=0.0, help="Seconds after the recording's start.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", min=0.0, help="Seconds after the recording's start.")] = None,
    everything: Annotated[
        bool,
        typer.Option("--everything", help="All that was recorded, for a station or a viewer; no service may run then."),
    ] = False,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> int:
    """Feed the running services (slam, mapper, detector, ...) with a recording's camera and vehicle."""
    from services.recorder.replay import Span, play
    from services.recorder.replay import check as check_span

    span = Span(begin, end, rate)
    check_span(span)
    result = play(loaded(config, settings, port).config, file, span, everything=everything)
    typer.echo(f"{result.sent} messages of {file.name} in {result.seconds:.1f} s", err=True)
    for fault in result.faults[:5]:
        typer.echo(f"left out: {fault}", err=True)
    if len(result.faults) > 5:
        typer.echo(f"left out: {len(result.faults) - 5} more", err=True)
    return 0 if result.sent else 3
