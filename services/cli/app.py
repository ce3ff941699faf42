"""The console script ``treedock``: every command, loaded when it is called, and the exit codes.

Nothing heavy is imported here: ``treedock --help`` answers at once.
"""

from __future__ import annotations

import importlib
import sys
from importlib.util import find_spec
from typing import Annotated, Any

import typer

from services.cli.certs import certs_app
from services.cli.config_command import config
from services.cli.fleet import fleet_app
from services.cli.inventory import inventory_app
from services.cli.run import run
from services.cli.service_command import OPTIONAL, SERVICES, service_command
from services.cli.topic import topic_app
from services.common.errors import GoalNotReachedError, InputError
from services.common.process import prepare_process

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

EXIT_DONE, EXIT_BUG, EXIT_INPUT, EXIT_NO_GOAL, EXIT_INTERRUPTED = 0, 1, 2, 3, 130

_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""UsageError of the click inside this typer: newer ones carry their own, so `import click` gives another class."""


def make_app() -> typer.Typer:
    """Return the command line with all its commands."""
    app = typer.Typer(
        name="treedock",
        help="Find the trees around a small aircraft with one RGB-D camera, and guide it up to them.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    app.callback()(_options)
    app.command()(run)
    for name in COMMAND_MODULES:
        if find_spec(f"services.cli.{name}") is not None:
            module = importlib.import_module(f"services.cli.{name}")
            app.command(name)(getattr(module, name))
    app.add_typer(topic_app, name="topic")
    app.add_typer(inventory_app, name="inventory")
    app.add_typer(fleet_app, name="fleet")
    app.add_typer(certs_app, name="certs")
    app.command()(config)
    for name, about in (SERVICES | OPTIONAL).items():
        app.command(name, help=about, rich_help_panel="Services (each its own process)")(service_command(name))
    return app


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"treedock {version('treedock')}")
        raise typer.Exit


def _options(
    *,
    version: Annotated[
        bool, typer.Option("--version", help="Show the version and end.", is_eager=True, callback=_show_version)
    ] = False,
) -> None:
    del version


def main() -> None:
    """Run the command line and exit: 0 done, 1 a bug, 2 bad usage or input, 3 ended without its goal."""
    prepare_process()
    sys.exit(invoke(sys.argv[1:]))


def invoke(arguments: list[str]) -> int:
    """Run one command and return its exit code."""
    try:
        result = make_app()(arguments, prog_name="treedock", standalone_mode=False)
    except InputError as error:
        return _tell(str(error), EXIT_INPUT)
    except GoalNotReachedError as error:
        return _tell(str(error), EXIT_NO_GOAL)
    except _USAGE_ERROR as error:
        context = getattr(error, "ctx", None)
        where = f" (see `{context.command_path} --help`)" if context else ""
        said = error.format_message()  # empty where the help was printed instead
        return _tell(f"{said}{where}", EXIT_INPUT) if said.strip() else EXIT_INPUT
    except typer.Exit as stop:
        return stop.exit_code
    except (KeyboardInterrupt, typer.Abort):
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        return _reader_left()
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # typer makes exit code 1 of it
            return _reader_left()
        raise
    except Exception:  # noqa: BLE001 - the one place where a bug ends
        import traceback

        traceback.print_exc()
        return _tell("this is a bug in treedock: please report it with the lines above", EXIT_BUG)
    return result if isinstance(result, int) else EXIT_DONE


def _reader_left() -> int:
    """End quietly when the reader of our output went away: ``treedock topic echo ... | head``."""
    sys.stderr.close()
    return EXIT_DONE


def _tell(text: str, code: int) -> int:
    sys.stderr.write(f"treedock: {' '.join(text.split())}\n")
    return code


if __name__ == "__main__":
    main()
