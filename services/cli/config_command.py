"""``treedock config``: the configuration as it is in force, and where each value came from."""

from __future__ import annotations

import json

import typer

from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded


def config(*, config: ConfigFile = None, settings: Settings = None, port: Port = None, as_json: AsJson = False) -> None:
    """Print the configuration in force: TOML, each value that is not a default with its origin."""
    from services.common.config_loader import to_toml

    found = loaded(config, settings, port)
    tree = found.config.model_dump(mode="json")
    typer.echo(json.dumps({"config": tree, "origins": found.origins}) if as_json else to_toml(tree, found.origins))
