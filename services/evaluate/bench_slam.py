"""slam by itself: the real recordings from several starts, and simulated turns on the spot."""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from schemas.camera import RgbdFrame
from services.camera.sources import BadFrame, open_recording
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.evaluate.ate import Ate, Trajectory, ate, read_trajectory
from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.offline import OfflineResult, run_offline

RECORDINGS = {"fr1_xyz": "tum_fr1_xyz_15hz", "fr1_desk": "tum_fr1_desk_15hz"}
START_OFFSETS = (0, 2, 4, 6, 8)
"""Frames left out at the beginning: another first frame is another set of keyframes, features and roundings."""
TURN_SEEDS = (11, 12, 13)
TURN_FRAMES = 285
"""At 15 Hz: rest, rise, and the whole turn on the spot of the reference path."""


@dataclass(frozen=True, slots=True)
class SlamRun:
    """One run over one sequence."""

    name: str
    frames: int
    tracked: int
    final: Ate
    online: Ate
    track_ms: tuple[float, ...]


def run(options: BenchOptions) -> BenchReport:
    """Measure slam on real and simulated sequences."""
    config = TreedockConfig()
    real: dict[str, list[SlamRun]] = {}
    for name, folder in RECORDINGS.items():
        sequence = options.data / folder
        if not sequence.is_dir():
            options.tell(f"{sequence} is absent: {name} is left out (--data names the folder of recordings)")
            continue
        offsets = START_OFFSETS[:1] if options.quick else START_OFFSETS
        real[name] = [_tell(options, run_slam(sequence, config, f"{name} from frame {k}", k)) for k in offsets]
    first = 0 if options.seed is None else options.seed * len(TURN_SEEDS) + 100
    seeds = TURN_SEEDS if options.seed is None else tuple(range(first, first + len(TURN_SEEDS)))
    turns = [_tell(options, run_turn(seed, config)) for seed in (seeds[:1] if options.quick else seeds)]
    return _report(real, turns, seeds)


def run_slam(sequence: Path, config: TreedockConfig, name: str, first_frame: int = 0) -> SlamRun:
    """Run slam alone over a sequence with groundtruth.txt, from its ``first_frame``-th frame on."""
    builders = {"slam": importlib.import_module("services.slam.service").build}
    frames: Iterable[RgbdFrame | BadFrame] = islice(open_recording(sequence, config.camera), first_frame, None)
    result = run_offline(frames, config, builders=builders)
    truth = read_trajectory(sequence / "groundtruth.txt")
    return SlamRun(
        name=name, frames=result.counts.frames, tracked=result.counts.tracked,
        final=ate(_trajectory(result.trajectory), truth), online=ate(_trajectory(result.online), truth),
        track_ms=_track_ms(result),
    )  # fmt: skip


def run_turn(seed: int, config: TreedockConfig) -> SlamRun:
    """Run slam over a simulated rise and turn on the spot in a fresh scene."""
    from services.simulator.catalogue import random_scene
    from services.simulator.write import write_sequence

    with tempfile.TemporaryDirectory(prefix="treedock-turn-") as folder:
        write_sequence(random_scene(seed), Path(folder), frames=TURN_FRAMES, reduced=True, seed=seed)
        return run_slam(Path(folder), config, f"turn, seed {seed}")


def _track_ms(result: OfflineResult) -> tuple[float, ...]:
    return tuple(result.stage_ms.get("slam.track", ())[1:])  # the first frame loads kernels and begins the map


def _trajectory(poses: Sequence[tuple[int, np.ndarray]]) -> Trajectory:
    if not poses:
        raise InputError("slam tracked no frame of the sequence")
    return Trajectory(np.array([stamp for stamp, _ in poses], dtype=np.int64), np.stack([T for _, T in poses]))


def _tell(options: BenchOptions, result: SlamRun) -> SlamRun:
    options.tell(_line(result))
    return result


def _line(r: SlamRun) -> str:
    return (
        f"{r.name}: {r.tracked}/{r.frames} tracked, ATE {100 * r.final.rmse_m:.2f} cm (online {100 * r.online.rmse_m:.2f}), "
        f"rotation at most {r.final.rotation_deg_max:.2f} deg, {np.median(r.track_ms):.0f} ms a frame"
    )


def _report(real: dict[str, list[SlamRun]], turns: Sequence[SlamRun], seeds: Sequence[int]) -> BenchReport:
    every = [run for runs in real.values() for run in runs] + list(turns)
    figures = {
        f"{name}_ate_m": round(float(np.median([r.final.rmse_m for r in runs])), 4) for name, runs in real.items()
    }
    track_ms = np.concatenate([r.track_ms for r in every])
    p50, p95 = np.percentile(track_ms, [50, 95])
    figures |= {
        "turn_lost": sum(r.frames - r.tracked for r in turns),
        "turn_rot_deg_max": round(max(r.final.rotation_deg_max for r in turns), 3),
        "turn_ate_m": round(max(r.final.rmse_m for r in turns), 4),
        "track_ms_p50": round(float(p50), 1),
        "track_ms_p95": round(float(p95), 1),
    }
    rows = [
        "| run | tracked | ATE (cm) | ATE online (cm) | worst rotation (deg) | ms a frame |",
        "|---|---|---|---|---|---|",
    ]
    rows += [
        f"| {r.name} | {r.tracked}/{r.frames} | {100 * r.final.rmse_m:.2f} | {100 * r.online.rmse_m:.2f} "
        f"| {r.final.rotation_deg_max:.2f} | {np.median(r.track_ms):.0f} |"
        for r in every
    ]
    return BenchReport(
        figures=figures,
        conditions={
            "real": "TUM RGB-D freiburg1, Kinect v1, every second frame; ATE after rigid alignment, median over the starts",
            "turns": f"simulated 360 deg at 30 deg/s, 640x480 rendered at half size, s 0.08 px, seeds {', '.join(map(str, seeds))}; worst of them",
            "time": "one thread, tracking and whatever mapping falls into a frame",
        },
        table="\n".join(rows),
    )  # fmt: skip
