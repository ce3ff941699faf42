"""``treedock command start|hold|resume|abort|land|choose ID|next``: an order to the aircraft, and its answer."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from schemas.orders import CommandName
from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded

if TYPE_CHECKING:
    from schemas.command import CommandReply

_NAMES: tuple[CommandName, ...] = get_args(CommandName)


def command(
    name: Annotated[str, typer.Argument(help=f"One of {', '.join(_NAMES)}.", show_default=False)],
    tree_id: Annotated[int | None, typer.Argument(min=0, help="For choose: the tree's id.", show_default=False)] = None,
    *,
    timeout: Annotated[float, typer.Option("--timeout", min=0.1, help="Seconds to wait for each answer.")] = 2.0,
    as_json: AsJson = False,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> None:
    """Order the aircraft: start, hold, resume, abort, land, choose a tree, next tree."""
    from services.common.errors import GoalNotReachedError, InputError

    known = next((n for n in _NAMES if n == name), None)
    if known is None:
        raise InputError(f"command {name!r}: expected one of {', '.join(_NAMES)}")
    if (known == "choose") != (tree_id is not None):
        raise InputError("command choose takes the id of a tree: treedock command choose 3; no other command does")
    reply = _ask(known, tree_id, timeout, loaded(config, settings, port).config)
    if as_json:
        typer.echo(json.dumps({"command": known, **reply.model_dump()}))
    else:
        typer.echo(f"{'accepted' if reply.accepted else 'refused'}: {reply.reason} (mission: {reply.state})")
    if not reply.accepted:
        raise GoalNotReachedError(f"command {known} was refused: {reply.reason}")


def _ask(name: CommandName, tree_id: int | None, timeout_s: float, tree: object) -> CommandReply:
    from services.common.bus import Bus
    from services.common.config import TreedockConfig
    from services.common.context import HealthBook
    from services.common.errors import InputError
    from services.common.session import opened_node
    from services.common.stop import StopSignal
    from services.navigator.client import send_command
    from services.security.identity import STATION
    from services.security.transport import shown_by

    assert isinstance(tree, TreedockConfig)
    if tree.security.folder is not None and (shown := shown_by(tree.security, tree.uav, None)).role != STATION:
        # the router would drop the question without a word
        raise InputError(
            f"command {name}: {shown.text} may only look; a station's certificate commands: security.identity = "
            '"station.NAME", issued and imported here (docs/operations.md)'
        )
    stop = StopSignal()
    stop.install()
    with opened_node(tree, None, lambda: stop.is_set, wait_s=0.0) as session:
        bus = Bus(session, tree.uav, HealthBook())
        reply = send_command(bus, name, tree_id, f"cli.{os.getpid()}", timeout_s)
    if reply is None:
        raise InputError(f"command {name}: no navigator of {tree.uav} answered within {timeout_s:g} s; is it running?")
    return reply
