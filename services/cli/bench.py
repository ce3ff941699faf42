"""``treedock bench NAME``: measure, say under which conditions, and give the figures."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.options import AsJson

if TYPE_CHECKING:
    from services.evaluate.bench import BenchReport

DataFolder = Annotated[
    Path | None, typer.Option("--data", help="Folder of the real recordings (default: $TREEDOCK_DATA)")
]
ResumeFolder = Annotated[Path, typer.Option("--out", help="Folder for results to resume from")]

KeepSequences = Annotated[
    bool, typer.Option("--keep-sequences", help="Keep rendered scenes for later calls (150 MB each)")
]


def bench(
    name: Annotated[str, typer.Argument(help="catalogue, detection, slam, refine, depth, missions, system ...")],
    *,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Draw fresh scenes from this seed")] = None,
    out: ResumeFolder = Path("bench"),
    data: DataFolder = None,
    scenes: Annotated[str, typer.Option("--scenes", help="Only these scenes, names separated by commas")] = "",
    count: Annotated[int | None, typer.Option("--count", min=1, help="How many runs (missions)")] = None,
    minutes: Annotated[
        float | None, typer.Option("--minutes", min=0.5, help="How long (soak); no further row after (faults)")
    ] = None,
    rendered: Annotated[
        bool, typer.Option("--rendered", help="With rendered images, real processes (missions)")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Less data: a look, not a measurement")] = False,
    doc: Annotated[Path | None, typer.Option("--doc", help="Put the result into this Markdown file")] = None,
    keep_sequences: KeepSequences = False,
    as_json: AsJson = False,
) -> None:
    """Run a benchmark and print its table and figures."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from services.evaluate.bench import BenchOptions, load_bench

    run = load_bench(name)
    options = BenchOptions(
        seed=seed, out=out, scenes=tuple(part.strip() for part in scenes.split(",") if part.strip()), quick=quick,
        keep_sequences=keep_sequences, count=count, minutes=minutes, doc=doc, rendered=rendered,
        tell=lambda line: typer.echo(line, err=True), **({"data": data} if data is not None else {}),
    )  # fmt: skip
    report = run(options)
    text = section_text(report)
    if doc is not None:
        write_section(doc, f"{name}-rendered" if rendered else name, text)
    typer.echo(text, err=as_json)
    if as_json:
        typer.echo(json.dumps({"bench": name, "figures": dict(report.figures)}))


_PLACES = ("--out", "--data")


def section_text(report: BenchReport) -> str:
    """Return conditions, table and figures as Markdown."""
    from services.evaluate.bench import machine

    conditions = {**report.conditions, "machine": machine()}
    lines = [f"- {name}: {value}" for name, value in conditions.items()]
    figures = ", ".join(f"{name} {value:g}" for name, value in report.figures.items())
    return "\n".join([*lines, "", report.table, "", f"Figures: {figures}"])


def write_section(doc: Path, name: str, text: str) -> None:
    """Replace the benchmark's section of a Markdown file."""
    from services.evaluate.bench import replace_section

    before = doc.read_text(encoding="utf-8") if doc.exists() else "# Benchmarks\n"
    command = f"`{' '.join(['treedock', *_without_places(sys.argv[1:])])}`"
    doc.write_text(replace_section(before, name, f"{command}\n\n{text}"), encoding="utf-8")


def _without_places(arguments: list[str]) -> list[str]:
    """Leave out where this machine keeps its files: the command is for others."""
    kept: list[str] = []
    previous = ""
    for argument in arguments:
        if previous not in _PLACES and argument.partition("=")[0] not in _PLACES:
            kept.append(argument)
        previous = argument
    return kept
