"""``treedock config``: the configuration as it is in force, and where each value came from."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded


def config(
    *,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
    migrate: Annotated[
        bool, typer.Option("--migrate", help="Write older files (--config, else /etc/treedock/*.toml) anew.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Print the configuration in force: TOML, each value that is not a default with its origin."""
    from services.common.config_loader import SYSTEM_DIRECTORY, to_toml
    from services.common.config_versions import NEWEST, migrate_file

    if migrate:
        for path in [config] if config else sorted(SYSTEM_DIRECTORY.glob("*.toml")):
            typer.echo(migrate_file(path), err=as_json)
    found = loaded(config, settings, port)
    tree = found.config.model_dump(mode="json")
    if as_json:
        typer.echo(json.dumps({"config": tree, "origins": found.origins}))
    elif not migrate:
        typer.echo(f"config_version = {NEWEST}\n{to_toml(tree, found.origins)}", nl=False)
