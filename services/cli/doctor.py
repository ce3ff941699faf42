"""``treedock doctor``: is this machine, and what runs on it, fit to fly? Each finding says what to do."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import AsJson, ConfigFile, Port, Settings, loaded

if TYPE_CHECKING:
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
    """Mend keys' rights, cut recordings and failed units; return whether anything was done."""
    import shutil
    import subprocess
    from pathlib import Path

    from services.recorder.recover import recover

    done = []
    for path in facts.loose_keys:
        Path(path).chmod(0o600)
        done.append(f"chmod 600 {path}")
    for path in facts.foreign_keys:
        owner = Path(path).parent.stat()
        shutil.chown(path, owner.st_uid, owner.st_gid)
        done.append(f"chown {owner.st_uid}:{owner.st_gid} {path}")
    done += [str(recover(Path(path))) for path in facts.recordings_cut]
    for name, state in sorted(facts.units.items()):
        if state == "failed":
            subprocess.run(["systemctl", "restart", name], check=False)
            done.append(f"systemctl restart {name}")
    for line in done:
        typer.echo(f"fixed: {line}", err=True)
    return bool(done)
