"""The console script ``treedock``: every command, loaded when it is called, and the exit codes.

Nothing heavy is imported here: ``treedock --help`` answers at once.
"""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer

from services.cli.commands import add_command, add_name, names
from services.common.errors import GoalNotReachedError, InputError
from services.common.process import prepare_process

EXIT_DONE, EXIT_BUG, EXIT_INPUT, EXIT_NO_GOAL, EXIT_INTERRUPTED = 0, 1, 2, 3, 130

_USAGE_ERROR: Any = typer.BadParameter.__mro__[1]
"""UsageError of the click inside this typer: newer ones carry their own, so `import click` gives another class."""


def make_app(called: str | None = None) -> typer.Typer:
    """Return the command line that serves a call of the command ``called``; the list of all names when it is none of them."""
    app = typer.Typer(
        name="treedock",
        help="Find the trees around a small aircraft with one RGB-D camera, and guide it up to them.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        add_completion=False,
    )
    app.callback()(_options)
    known = names()
    if called in known:
        add_command(app, called)
    else:
        for name in known:
            add_name(app, name)
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
        result = make_app(next(iter(arguments), None))(arguments, prog_name="treedock", standalone_mode=False)
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
