"""``treedock fleet fly | list | forget``: several aircraft in a simulated forest; the book of who has visited which tree."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import AsJson, ConfigFile, Settings, loaded

if TYPE_CHECKING:
    from services.fleet.journal import Journal

fleet_app = typer.Typer(
    help="Several aircraft: fly them in simulation, look into the arbiter's book.", no_args_is_help=True
)

_EXIT_NOT_REACHED = 3

Count = Annotated[int, typer.Option("--aircraft", help="How many.", min=1, max=9)]
Seed = Annotated[int, typer.Option("--seed", help="Of forest, weather, link and clocks.", min=0)]
WithPx4 = Annotated[bool, typer.Option("--px4", help="On simulated autopilots, with the live guard: ten times slower.")]


@fleet_app.command()
def fly(*, aircraft: Count = 2, seed: Seed = 0, px4: WithPx4 = False, as_json: AsJson = False) -> int:
    """Fly a fleet in one forest, without rendering, over a link that drops; exit 0 when each tree was visited once."""
    from services.evaluate.bench_fleet import fly as flown
    from services.evaluate.bench_fleet import line_of

    row = flown(seed, aircraft, px4=px4)
    typer.echo(line_of(row), err=as_json)
    if as_json:
        typer.echo(json.dumps(row))
    good = row["once"] == row["expected"] and not (row["double_claims"] or row["touches"] or row["met"])
    return 0 if good else _EXIT_NOT_REACHED


@fleet_app.command("list")
def list_book(*, as_json: AsJson = False, config: ConfigFile = None, settings: Settings = None) -> None:
    """List the trees that are done, by the arbiter's book; the station must not be running."""
    journal = _journal(config, settings)
    try:
        rows = _done_rows(journal)
    finally:
        journal.close()
    if as_json:
        typer.echo(json.dumps({"done": rows}))
        return
    for row in rows:
        typer.echo(
            f"{row['latitude_deg']:.7f} {row['longitude_deg']:.7f}  +- {row['sigma_m']:.2f} m  by {row['uav']} (its tree {row['tree']})"
        )
    typer.echo(f"{len(rows)} trees done")


@fleet_app.command()
def forget(*, config: ConfigFile = None, settings: Settings = None) -> None:
    """Begin a new round: all trees may be visited again; leases are kept. The station must not be running."""
    from services.fleet.book import Memory

    journal = _journal(config, settings)
    try:
        memory = journal.memory or Memory()
        if journal.memory is not None:
            journal.write(Memory(memory.leases))
    finally:
        journal.close()
    typer.echo(f"{len(memory.done)} trees forgotten")


def _journal(config: Path | None, settings: list[str] | None) -> Journal:
    from services.common.errors import InputError
    from services.common.files import is_there
    from services.fleet.journal import Journal, book_path

    path = book_path(loaded(config, settings, None).config.station.fleet)
    if not is_there(path):  # another user's, or none: a new one would be empty, and its forgetting would say done
        raise InputError(f"{path}: there is no book; name the station's with --set station.fleet.book=FILE")
    return Journal(path, None)


def _done_rows(journal: Journal) -> list[dict[str, Any]]:
    from services.inventory.geodesy import TangentPlane

    plane = TangentPlane(*journal.origin_deg)
    rows = []
    for done in journal.memory.done if journal.memory else ():
        latitude, longitude, _ = plane.to_geodetic(*done.at_m, 0.0)
        rows.append({"uav": done.uav, "tree": done.tree_id, "latitude_deg": latitude, "longitude_deg": longitude,
                     "sigma_m": done.sigma_m})  # fmt: skip
    return rows
