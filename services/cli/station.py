"""``treedock station``: the ground station, a page with map, state and commands of all aircraft."""

from __future__ import annotations

from typing import Annotated

import typer

from services.cli.options import ConfigFile, Port, Settings

Host = Annotated[
    str | None, typer.Option("--host", help="Where the page is served; others than this machine need a token.")
]
PagePort = Annotated[int | None, typer.Option("--page-port", help="The page's port; 0: any.", min=0, max=65535)]
Cloud = Annotated[
    bool,
    typer.Option("--cloud/--no-cloud", help="Let the 3D view ask for the point cloud: up to 48 KB a submap by radio."),
]
Browser = Annotated[bool, typer.Option("--browser", help="Open the page in a browser.")]


def station(
    *,
    host: Host = None,
    page_port: PagePort = None,
    cloud: Cloud = True,
    browser: Browser = False,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
    parent: Annotated[int | None, typer.Option("--parent", hidden=True)] = None,
    sim_clock: Annotated[bool, typer.Option("--sim-clock", help="Live by the simulator's time.")] = False,
) -> int:
    """Serve the ground station's page until it is stopped: map, state, trees and commands of all aircraft."""
    from services.cli.service_command import end_with, run_by_name

    if parent is not None:
        end_with(parent)
    flags: dict[str, object] = {"station.host": host, "station.port": page_port}
    more = {key: value for key, value in flags.items() if value is not None}
    if not cloud:
        more["station.cloud"] = False
    if sim_clock:
        more["clock"] = "sim"
    if browser:
        more["station.open_browser"] = True
    return run_by_name("station", config, settings, port, more)
