"""Options that several commands share, and the configuration that they lead to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from services.common.config_loader import LoadedConfig

ConfigFile = Annotated[Path | None, typer.Option("--config", help="Configuration file, TOML or JSON.", metavar="FILE")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="Set one key, for example slam.features=800; may be given again.", metavar="KEY=VALUE"),
]
Port = Annotated[int | None, typer.Option("--port", help="The router's port.", min=1, max=65535)]
AsJson = Annotated[bool, typer.Option("--json", help="Machine-readable output on stdout.")]


def loaded(
    config: Path | None, settings: list[str] | None, port: int | None, more: Mapping[str, object] | None = None
) -> LoadedConfig:
    """Return the configuration from its places and these options.

    Raises:
        InputError: for what cannot be used.
    """
    from services.common.config_loader import load

    overrides: dict[str, object] = dict(more or {})
    if port is not None:
        overrides["router.port"] = port
    return load(config, settings or (), overrides)
