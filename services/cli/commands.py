"""The commands of ``treedock``: where each is defined, and the command line of one of them or of all their names.

What a command's parameters are is asked of typer only for the command that is called: for all of them it takes three times
as long as everything else that a start does, and every service is started by its command.
"""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import typer

from services.cli.service_command import OPTIONAL, SERVICES, service_command

COMMAND_MODULES = (
    "process",
    "detect",
    "simulate",
    "calibrate",
    "catalogue",
    "bench",
    "warm",
    "command",
    "station",
    "record",
    "recordings",
    "replay",
    "view",
    "doctor",
)
"""Modules beside this one that hold one command of the same name each."""

_COMMANDS = {"run": "run", **{name: name for name in COMMAND_MODULES}, "config": "config_command"}
"""Module of each command, in the order in which they are listed."""
_GROUPS = ("topic", "inventory", "fleet", "certs")
"""Modules that hold commands of their own, as ``NAME_app``."""
_SERVICES = SERVICES | OPTIONAL
_SERVICES_PANEL = "Services (each its own process)"


def names() -> list[str]:
    """Return the names of all commands and groups that are installed, in the order of the help."""
    found = [name for name, module in _COMMANDS.items() if find_spec(f"services.cli.{module}") is not None]
    return [*found, *_GROUPS, *_SERVICES]


def add_command(app: typer.Typer, name: str) -> None:
    """Add a command that can be called."""
    if name in _GROUPS:
        app.add_typer(_group(name), name=name)
    elif name in _SERVICES:
        app.command(name, help=_SERVICES[name], rich_help_panel=_SERVICES_PANEL)(service_command(name))
    else:
        app.command(name)(_function(name))


def add_name(app: typer.Typer, name: str) -> None:
    """Add a command as the list of commands shows it: without its parameters."""
    about = _SERVICES.get(name) or (_group(name).info.help if name in _GROUPS else inspect.getdoc(_function(name)))
    app.command(name, help=about, rich_help_panel=_SERVICES_PANEL if name in _SERVICES else None)(_nothing)


def _nothing() -> None:
    """Stand for a command that is not called."""


def _group(name: str) -> typer.Typer:
    group = getattr(importlib.import_module(f"services.cli.{name}"), f"{name}_app")
    assert isinstance(group, typer.Typer)
    return group


def _function(name: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(importlib.import_module(f"services.cli.{_COMMANDS[name]}"), name)
    return function
