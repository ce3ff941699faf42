"""``treedock replay``: a recording back onto the bus, at its own pace or another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import ConfigFile, Port, Settings, loaded

if TYPE_CHECKING:
    from services.recorder.replay import Played, Span


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
    typer.echo(said(file, span, result), err=True)
    if result.denied:
        words = ", ".join(f"{count} of {name}" for name, count in sorted(result.denied.items()))
        typer.echo(
            f"left out: {words}: on an encrypted bus a replay speaks as the camera, which may not say them", err=True
        )
    for fault in result.faults[:5]:
        typer.echo(f"left out: {fault}", err=True)
    if len(result.faults) > 5:
        typer.echo(f"left out: {len(result.faults) - 5} more", err=True)
    return 0 if result.sent else 3


def said(file: Path, span: Span, played: Played) -> str:
    """Return what was played in words; where that is less than was asked for, how long the recording is."""
    less = not (played.sent or played.denied) or (span.end_s is not None and span.end_s > played.length_s)
    return f"{played.sent} messages of {file.name} in {played.seconds:.1f} s" + (
        f"; the recording is only {played.length_s:.1f} s long" if less else ""
    )
