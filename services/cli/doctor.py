"""``treedock doctor``: is this machine, and what runs on it, fit to fly? Each finding says what to do."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from services.doctor.model import Facts, Finding

_MARKS = {"ok": ("ok  ", typer.colors.GREEN), "warn": ("warn", typer.colors.YELLOW),
          "fail": ("FAIL", typer.colors.RED), "unknown": ("?   ", typer.colors.WHITE)}  # fmt: skip


def doctor(
    *,
    fix: Annotated[bool, typer.Option("--fix", help="Mend what can be mended without risk.")] = False,
    as_json: AsJson = False,
    config: ConfigFile = None,
    settings: Settings = None,
    port: Port = None,
) -> int:
    """Look at units, router, certificates, clock, memory, disk, camera and rates; exit 3 when something fails."""
    from dataclasses import asdict

    from services.doctor.facts import gather
    from services.doctor.findings import judge

    tree = loaded(config, settings, port).config
    facts = gather(tree)
    if fix and _mended(facts):
        facts = gather(tree)
    findings = judge(facts)
    if as_json:
        typer.echo(json.dumps({"fit": _fit(findings), "findings": [asdict(finding) for finding in findings]}))
    else:
        _print(findings)
    return 0 if _fit(findings) else 3


def _fit(findings: list[Finding]) -> bool:
    return all(finding.level != "fail" for finding in findings)


def _print(findings: list[Finding]) -> None:
    width = max(len(finding.about) for finding in findings)
    for finding in findings:
        mark, colour = _MARKS[finding.level]
        typer.echo(f"{typer.style(mark, fg=colour)}  {finding.about:<{width}}  {finding.text}")
        if finding.do and finding.level != "ok":
            typer.echo(f"      {'':<{width}}  -> {finding.do}")


def _mended(facts: Facts) -> bool:
    """Mend keys' rights, cut recordings and failed units; say of each whether it is; return whether anything was done."""
    from services.common.errors import InputError

    done = False
    for words, mend in _mending(facts):
        try:
            said = mend()
        except (OSError, InputError) as error:
            typer.echo(f"not fixed: {words}: {error}", err=True)
            continue
        typer.echo(f"fixed: {said or words}", err=True)
        done = True
    return done


def _mending(facts: Facts) -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield what can be mended: in words, and what does it (and may return better words)."""
    import shutil
    from functools import partial
    from pathlib import Path

    from services.recorder.recover import recover

    for path in facts.loose_keys:
        yield f"chmod 600 {path}", partial(Path(path).chmod, 0o600)
    for path in facts.foreign_keys:
        owner = Path(path).parent.stat()
        yield f"chown {owner.st_uid}:{owner.st_gid} {path}", partial(shutil.chown, path, owner.st_uid, owner.st_gid)
    for path in facts.recordings_cut:
        yield path, partial(recover, Path(path))
    for name, state in sorted(facts.units.items()):
        if state == "failed":
            yield f"systemctl restart {name}", partial(_restart, name)


def _restart(unit: str) -> None:
    import subprocess

    done = subprocess.run(["systemctl", "restart", unit], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(done.stderr.strip() or f"exit code {done.returncode}")
