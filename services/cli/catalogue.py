"""``treedock catalogue``: the reference's twenty scenes through the whole chain; go on where it stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from services.cli.bench import KeepSequences, ResumeFolder, bench
from services.cli.options import AsJson


def catalogue(
    *,
    scenes: Annotated[str, typer.Option("--scenes", help="Only these scenes, names separated by commas")] = "",
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Fresh scenes of both kinds from this seed")] = None,
    out: ResumeFolder = Path("bench"),
    quick: Annotated[bool, typer.Option("--quick", help="Rendered at half size")] = False,
    keep_sequences: KeepSequences = False,
    as_json: AsJson = False,
) -> None:
    """Count the trees found in the catalogue scenes. Finished scenes are kept and not done again."""
    bench("catalogue", seed=seed, out=out, scenes=scenes, quick=quick, keep_sequences=keep_sequences, as_json=as_json)
