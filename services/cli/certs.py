"""``treedock certs init|issue|renew|revoke|list|export``: the fleet's certificate authority."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import AsJson

if TYPE_CHECKING:
    import datetime as dt
    from collections.abc import Sequence

    from services.security.authority import Authority
    from services.security.identity import Identity

certs_app = typer.Typer(
    help="Certificates: one authority for the fleet, one certificate per service and station.", no_args_is_help=True
)

Folder = Annotated[Path, typer.Option("--folder", help="The authority's folder; keep it off the aircraft.")]
Names = Annotated[
    list[str], typer.Argument(help="Identities: uav1.slam, station.alice; uav1.all for a whole aircraft.")
]
Days = Annotated[int, typer.Option("--days", min=1, max=36500, help="Validity of the certificates.")]
Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", help="Address under which nodes reach the router; may be given again."),
]
_FOLDER = Path("treedock-certs")
_DAYS = 397
_MACHINE_FOLDER = Path("/etc/treedock/certs")


@certs_app.command("init")
def init(*, folder: Folder = _FOLDER) -> None:
    """Make a new authority."""
    from services.security.authority import Authority

    Authority.create(folder, _now())
    typer.echo(f"authority made in {folder}; {folder / 'ca.key'} is the fleet's secret: keep it, copy it nowhere")


@certs_app.command("issue")
def issue(names: Names, *, folder: Folder = _FOLDER, days: Days = _DAYS, host: Hosts = None) -> None:
    """Issue certificates; one that an identity holds already is revoked."""
    with _opened(folder) as authority:
        _issue_all(authority, [(identity, host) for identity in _expanded(names)], days)
    typer.echo(_next_step(folder))


@certs_app.command("renew")
def renew(names: Names, *, folder: Folder = _FOLDER, days: Days = _DAYS, host: Hosts = None) -> None:
    """Issue anew what was issued before, with the same addresses unless --host names others."""
    from services.common.errors import InputError

    with _opened(folder) as authority:
        identities = _expanded(names, authority)
        hosts = {entry.identity: entry.hosts for entry in authority.register.entries}  # of the latest
        new = [identity.text for identity in identities if identity.text not in hosts]
        if new:
            raise InputError(f"{new[0]}: nothing was issued yet; `treedock certs issue {new[0]}` does it")
        _issue_all(authority, [(identity, host or hosts[identity.text]) for identity in identities], days)
    typer.echo(_next_step(folder))


@certs_app.command("revoke")
def revoke(names: Names, *, folder: Folder = _FOLDER) -> None:
    """Take all rights from identities; routers refuse them once they have the new list."""
    with _opened(folder) as authority:
        identities = _expanded(names, authority)
        for identity in identities:  # all or nothing: a mistyped name is noticed before the first is revoked
            authority.holding(identity)
        _revoke_all(authority, identities)
    typer.echo(
        f"bring the new {folder / 'identities.json'} to every router's machine (certs export and import; where nothing was "
        "renewed since, copying it to /etc/treedock/certs does): the router there takes it within seconds"
    )


@certs_app.command("list")
def list_certificates(*, folder: Folder = _FOLDER, as_json: AsJson = False) -> None:
    """Show what was issued, until when it holds, and what is revoked."""
    from dataclasses import asdict

    from services.security.register import Register

    entries = Register.read(folder).entries
    if as_json:
        typer.echo(json.dumps([asdict(entry) for entry in entries]))
        return
    if not entries:
        typer.echo("nothing was issued yet; `treedock certs issue uav1.all` does it for a whole aircraft")
    width = max((len(entry.identity) for entry in entries), default=0)
    now = _now().strftime("%Y-%m-%dT%H:%M:%SZ")
    for entry in entries:
        state = "revoked" if entry.revoked else "expired" if entry.valid_until < now else "valid"
        where = f"  at {', '.join(entry.hosts)}" if entry.hosts else ""
        typer.echo(f"{entry.identity:<{width}}  {state:<7}  until {entry.valid_until[:10]}{where}")


@certs_app.command("export")
def export(
    names: Names,
    to: Annotated[Path, typer.Option("--to", help="Folder for the machine, for example /etc/treedock/certs.")],
    *,
    folder: Folder = _FOLDER,
) -> None:
    """Copy what a machine with these nodes needs; never the authority's key."""
    with _opened(folder) as authority:
        files = authority.export(_expanded(names, authority), to)
    typer.echo(f"{len(files)} files in {to}; on the machine they are for: sudo treedock certs import THAT_FOLDER")


@certs_app.command("import")
def import_(
    source: Annotated[Path, typer.Argument(help="Folder that `certs export` made, for example on a USB stick.")],
    *,
    to: Annotated[Path, typer.Option("--to", help="Where this machine's services look.")] = _MACHINE_FOLDER,
) -> None:
    """Check what was exported for this machine and lay it where its services look."""
    from services.security.machine import bring

    brought = bring(source, to, _now())
    typer.echo(
        f'{len(brought.files)} files in {to}; security.folder = "{to}" and router.protocol = "tls" make the services use '
        "them. A router that runs takes a new list by itself"
    )
    if brought.revoked:
        typer.echo(f"revoked, left out and removed where they were: {', '.join(brought.revoked)}")
    if brought.changed:
        typer.echo(f"certificates that were here changed, restart what runs with them: {_restart_of(brought.changed)}")


def _restart_of(changed: Sequence[Identity]) -> str:
    from services.security.identity import STATION

    ground = {identity.role == STATION for identity in changed}
    targets = " ".join(f"treedock{'-station' * here}.target" for here in sorted(ground))
    return f"sudo systemctl restart {targets}"


@contextmanager
def _opened(folder: Path) -> Iterator[Authority]:
    """Open the authority for one command at a time: two that write its list would lose each other's entries."""
    from services.security.authority import CA_KEY, Authority

    with ExitStack() as held:
        with suppress(OSError):  # no such folder, which is told below, or a file system without locks
            holder = os.open(folder, os.O_RDONLY)
            held.callback(os.close, holder)
            fcntl.flock(holder, fcntl.LOCK_EX)  # the other command is short: this one waits
        authority = Authority.open(folder)
        if (folder / CA_KEY).stat().st_mode & 0o077:  # told, not refused: a stick's file system may know no rights
            typer.echo(f"warning: {folder / CA_KEY}, the fleet's secret, can be read by others: chmod 600 it", err=True)
        yield authority


def _issue_all(authority: Authority, asked: Sequence[tuple[Identity, Sequence[str] | None]], days: int) -> None:
    for identity, hosts in asked:
        authority = authority.issue(identity, _now(), days, tuple(hosts or ("127.0.0.1", "localhost")))
        typer.echo(f"{identity.text}: valid until {authority.register.entries[-1].valid_until[:10]}")


def _revoke_all(authority: Authority, identities: Sequence[Identity]) -> None:
    for identity in identities:
        authority = authority.revoke(identity)
        typer.echo(f"{identity.text}: revoked")


def _expanded(names: Sequence[str], authority: Authority | None = None) -> list[Identity]:
    """Return the identities, with ``uav1.all`` replaced by the aircraft's services (those that hold one, by a list).

    Raises:
        InputError: a name is none, or stands for nothing: told before the first certificate is touched.
    """
    from services.security.identity import Identity

    found: list[str] = []
    for name in names:
        first, dot, role = name.partition(".")
        found += _all_of(first, authority) if dot and role == "all" else [name]
    return [Identity.parse(name) for name in dict.fromkeys(found)]


def _all_of(first: str, authority: Authority | None) -> list[str]:
    from services.cli.service_command import OPTIONAL, SERVICES
    from services.common.errors import InputError
    from services.security.identity import READER, STATION

    if authority is None:
        if first == STATION:  # each would be a station of that name, with the right to command every aircraft
            raise InputError("station.all: name each station, for example station.alice")
        aboard = [service for service in (*SERVICES, *OPTIONAL) if service not in {"simulator", "station"}]
        return [f"{first}.{service}" for service in (*aboard, READER)]
    held = {e.identity for e in authority.register.entries if not e.revoked and e.identity.startswith(f"{first}.")}
    if not held:
        raise InputError(f"{first}.all: nothing of {first} holds a valid certificate; `treedock certs list` shows them")
    return sorted(held)


def _next_step(folder: Path) -> str:
    return (
        f"in {folder}; `treedock certs export NAMES --to FOLDER` collects what a machine needs. Routers know new "
        "certificates once they have the new identities.json"
    )


def _now() -> dt.datetime:
    import datetime as dt

    return dt.datetime.now(dt.UTC)
