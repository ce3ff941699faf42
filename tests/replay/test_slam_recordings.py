"""slam on the real recordings: accuracy and share of tracked frames; skipped where they are absent."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from services.common.config import TreedockConfig
from services.evaluate.bench_slam import run_slam

DATA = Path(os.environ.get("TREEDOCK_DATA") or Path(__file__).parents[2].parent / "shared" / "data")


@pytest.mark.parametrize(("folder", "limit_m"), [("tum_fr1_xyz_15hz", 0.010), ("tum_fr1_desk_15hz", 0.018)])
def test_real_recording_is_tracked_whole_and_accurate(folder: str, limit_m: float) -> None:
    sequence = DATA / folder
    if not sequence.is_dir():
        pytest.skip(f"{sequence} is absent")
    run = run_slam(sequence, TreedockConfig(), folder)
    assert run.tracked == run.frames
    assert run.final.rmse_m <= limit_m
