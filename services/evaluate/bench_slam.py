"""slam by itself: the real recordings from several starts, simulated turns on the spot, and faults during such turns.

Each run is a line in ``slam.jsonl``; a later call with the same code goes on from there. ``--count`` limits the turns.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from schemas.camera import RgbdFrame
from services.camera.sources import BadFrame, open_recording
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.evaluate.ate import Ate, Trajectory, ate, read_trajectory
from services.evaluate.bench import BenchOptions, BenchReport, code_version
from services.evaluate.bench_catalogue import _SIMULATOR, _append, _read_results
from services.evaluate.offline import OfflineResult, run_offline
from services.evaluate.slam_stress import FAULTS, run_case
from services.evaluate.slam_tables import Row, report
from services.evaluate.slam_turns import Turn, read_turn, rendered_turn, run_turn

RECORDINGS = {"fr1_xyz": "tum_fr1_xyz_15hz", "fr1_desk": "tum_fr1_desk_15hz"}
START_OFFSETS = (0, 2, 4, 6, 8)
"""Frames left out at the beginning: another first frame is another set of keyframes, features and roundings."""
TURNS = 20
FIRST_SEED = 11
FAULT_SCENES, FAULT_MOMENTS = 5, 4
"""Each fault in so many of the turns, at so many moments."""
_CODE = (
    "schemas", "services.common", "services.camera", "services.slam", *_SIMULATOR, "services.evaluate.slam_turns",
    "services.evaluate.slam_stress",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class SlamRun:
    """One run over one sequence."""

    name: str
    frames: int
    tracked: int
    final: Ate
    online: Ate
    track_ms: tuple[float, ...]


class _Book:
    """Rows by key, each computed once."""

    def __init__(self, options: BenchOptions) -> None:
        self._path = options.out / "slam.jsonl"
        self._done = _read_results(self._path)
        self._settings = {"code": code_version(_CODE), "config": TreedockConfig().slam.model_dump(mode="json")}

    def has(self, **what: str | int) -> bool:
        """Return whether a row is there."""
        return self._key(what) in self._done

    def row(self, make: Callable[[], Row], **what: str | int) -> Row:
        """Return the row of ``what``, made now if it is not there."""
        key = self._key(what)
        if key not in self._done:
            self._done[key] = {**what, **make()}
            _append(self._path, {"key": key, **self._done[key]})
        return self._done[key]

    def _key(self, what: Mapping[str, str | int]) -> str:
        return json.dumps({**what, **self._settings}, sort_keys=True)


def run(options: BenchOptions) -> BenchReport:
    """Measure what is not measured yet on real and simulated sequences, and report on all."""
    import cv2

    from services.slam.warm import warm

    cv2.setNumThreads(1)
    warm()
    book = _Book(options)
    real = _recordings(options, book)
    count = options.count or (1 if options.quick else TURNS)
    first = FIRST_SEED if options.seed is None else 1000 + options.seed * TURNS
    turns, faults = [], []
    for number in range(count):
        turn, cases = _scene(options, book, first + number, with_faults=number < FAULT_SCENES)
        turns.append(turn)
        faults.extend(cases)
    return report(real, turns, faults)


def _recordings(options: BenchOptions, book: _Book) -> list[Row]:
    rows = []
    for name, folder in RECORDINGS.items():
        sequence = options.data / folder
        if not sequence.is_dir():
            options.tell(f"{sequence} is absent: {name} is left out (--data names the folder of recordings)")
            continue
        for offset in START_OFFSETS[:1] if options.quick else START_OFFSETS:
            row = book.row(lambda s=sequence, n=name, k=offset: _real_row(s, n, k), recording=name, offset=offset)  # type: ignore[misc]
            options.tell(
                f"{name} from frame {offset}: {row['tracked']}/{row['frames']}, ATE {100 * row['ate_m']:.2f} cm"
            )
            rows.append(row)
    return rows


def _real_row(sequence: Path, name: str, offset: int) -> Row:
    r = run_slam(sequence, TreedockConfig(), name, offset)
    return {
        "frames": r.frames, "tracked": r.tracked, "ate_m": r.final.rmse_m, "online_m": r.online.rmse_m,
        "rot_first_deg": r.final.rotation_deg_max, "track_ms": [round(ms, 2) for ms in r.track_ms],
    }  # fmt: skip


def _scene(options: BenchOptions, book: _Book, seed: int, *, with_faults: bool) -> tuple[Row, list[Row]]:
    """Return the rows of one turn and of its faults; rendered only when something is missing."""
    config = TreedockConfig().slam
    moments = (1 if options.quick else FAULT_MOMENTS) if with_faults else 0
    wanted = [(name, moment) for name in FAULTS for moment in range(moments)]
    missing = not book.has(turn=seed) or not all(book.has(turn=seed, fault=n, moment=m) for n, m in wanted)
    held: list[Turn] = []

    def turn() -> Turn:
        return held[0]

    def rows() -> tuple[Row, list[Row]]:
        whole = book.row(lambda: run_turn(seed, turn(), config), turn=seed)
        options.tell(
            f"turn {seed}: {whole['tracked']}/{whole['frames']}, ATE {100 * whole['ate_m']:.2f} cm, "
            f"{whole['rot_after_loop_deg']:.2f} deg after the loop, leans {whole['tilt_deg']:.2f} deg"
        )
        cases = []
        for name, moment in wanted:
            case = book.row(
                lambda n=name, m=moment: run_case(turn(), n, 10 * seed + m, config),  # type: ignore[misc]
                turn=seed, fault=name, moment=moment,
            )  # fmt: skip
            options.tell(f"turn {seed}, {name}, moment {moment}: {'good' if case['good'] else 'not good'}")
            cases.append(case)
        return whole, cases

    if not missing:
        return rows()
    with rendered_turn(seed, options) as folder:
        held.append(read_turn(folder))
        return rows()


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


def _track_ms(result: OfflineResult) -> tuple[float, ...]:
    return tuple(result.stage_ms.get("slam.track", ())[1:])  # the first frame loads kernels and begins the map


def _trajectory(poses: Sequence[tuple[int, np.ndarray]]) -> Trajectory:
    if not poses:
        raise InputError("slam tracked no frame of the sequence")
    return Trajectory(np.array([stamp for stamp, _ in poses], dtype=np.int64), np.stack([T for _, T in poses]))
