"""``treedock inventory show | export``: the trees that all flights have found."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.options import AsJson, ConfigFile, Settings, loaded

if TYPE_CHECKING:
    from collections.abc import Sequence

inventory_app = typer.Typer(help="The trees that all flights have found.", no_args_is_help=True)

Database = Annotated[
    str | None, typer.Option("--database", help="GeoPackage file or postgresql:// URL (default: the station's).")
]
Everything = Annotated[bool, typer.Option("--all", help="Merged and withdrawn trees too.")]


def _rows(
    database: str | None, config: Path | None, settings: list[str] | None, *, everything: bool
) -> list[dict[str, Any]]:
    from services.inventory.export import tree_rows
    from services.inventory.store import open_store

    tree = loaded(config, settings, None).config
    store = open_store(database if database is not None else tree.station.inventory.database, read_only=True)
    try:
        tables = [store.rows(name) for name in ("trees", "trees_local", "sites")]
    finally:
        store.close()
    return tree_rows(*tables, everything=everything)


@inventory_app.command()
def show(
    *,
    database: Database = None,
    everything: Everything = False,
    as_json: AsJson = False,
    config: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """List the trees."""
    import json

    rows = _rows(database, config, settings, everything=everything)
    if as_json:
        typer.echo(json.dumps({"trees": rows}))
        return
    _print_table(rows)
    local = sum(row["frame"] == "local" for row in rows)
    if local:
        typer.echo(
            f"{local} of {len(rows)} are local: their flights had no start point (station.inventory.start_points)"
        )


def _print_table(rows: Sequence[dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("tree", "where", "diameter", "± xy", "flights", "seen", "suitable", "visited")
    for row in rows:
        where = f"x {row['x_m']:.2f} y {row['y_m']:.2f} m (site {row['site']})"
        if row["frame"] == "global":
            where = f"{row['latitude_deg']:.7f} {row['longitude_deg']:.7f}"
        table.add_row(
            str(row["tree_id"]), where, f"{row['diameter_cm']:.1f} cm", f"{row['sigma_xy_m'] * 100:.0f} cm",
            str(row["flights"]), str(row["observations"]), "yes" if row["suitable"] else "no",
            "yes" if row["visited"] else "no",
        )  # fmt: skip
    Console().print(table)


@inventory_app.command()
def export(
    out: Annotated[Path, typer.Argument(help="File to write: .csv, .geojson or .json.")],
    *,
    database: Database = None,
    everything: Everything = False,
    config: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """Write the trees as CSV or GeoJSON; the database itself is a GeoPackage that QGIS opens."""
    from services.common.errors import InputError
    from services.inventory.export import csv_bytes, geojson_bytes

    makers = {".csv": csv_bytes, ".geojson": geojson_bytes, ".json": geojson_bytes}
    make = makers.get(out.suffix.lower())
    if make is None:
        raise InputError(f"{out}: expected a name that ends in {', '.join(makers)}")
    rows = _rows(database, config, settings, everything=everything)
    try:
        out.write_bytes(make(rows))
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror}") from error
    typer.echo(f"{len(rows)} trees in {out}", err=True)
