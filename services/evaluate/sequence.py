"""A recording in, a folder of results out: the work behind ``treedock process``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from schemas.slam import Keyframe
from schemas.topics import SLAM_KEYFRAME, VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.camera.sources import Source, open_recording
from services.evaluate import exports, gis_exports
from services.evaluate.atomic import prepare, write_files
from services.evaluate.metrics import metrics, metrics_bytes
from services.evaluate.offline import Counts, OfflineResult, run_offline
from services.evaluate.report import report_bytes
from services.evaluate.sightings import sightings

if TYPE_CHECKING:
    from services.common.config import TreedockConfig
    from services.evaluate.fine import FineResult

Progress = Callable[[Counts, Source], None]
FineProgress = Callable[[int, int], None]
"""Called with the frames fused so far, and how many there will be."""


def process_sequence(
    sequence: Path,
    out: Path,
    config: TreedockConfig,
    *,
    camera: Path | None = None,
    skip_bad_frames: bool = False,
    fine: bool = False,
    progress: Progress | None = None,
    fine_progress: FineProgress | None = None,
) -> dict[str, Any]:
    """Run the chain over a recording, write the results into ``out`` and return the metrics.

    ``fine`` reads it a second time for the finer map; the other results are the same with it and without.

    Raises:
        InputError: the recording, the configuration or ``out`` cannot be used; ``out`` is then as it was.
    """
    prepare(out)
    settings = config.camera
    if camera is not None:
        settings = settings.model_copy(update={"camera_file": str(camera)})
    source = open_recording(sequence, settings)
    _single_threaded()
    result = run_offline(
        source, config, companions=_vehicle_states(sequence), keyframes_ns=recorded_keyframes(sequence), skip_bad_frames=skip_bad_frames,
        adjust_keyframes=config.fine.full_keyframes if fine else 0,
        progress=None if progress is None else lambda counts: progress(counts, source),
    )  # fmt: skip
    result.stage_ms.update({f"camera.{stage}": ms for stage, ms in sorted(source.stage_ms.items())})
    result.counters.update({f"camera.{name}": value for name, value in source.watch.counts().items()})
    finer = _fine(open_recording(sequence, settings), result, config, fine_progress) if fine else None
    values = metrics(result) | {"source_note": source.total()} | _fine_metrics(finer)
    write_files(out, result_files(sequence.resolve().name, result, values, finer))
    return values


def _fine(
    again: Source, result: OfflineResult, config: TreedockConfig, progress: FineProgress | None
) -> FineResult:  # fmt: skip
    from services.evaluate.fine import fine_map

    whole = len(result.adjusted)
    tell = None if progress is None else lambda done: progress(done, whole)
    return fine_map(again, result.adjusted, result.trees, config.fine, tell)


def _fine_metrics(finer: FineResult | None) -> dict[str, Any]:
    if finer is None:
        return {}
    return {"fine": {
        "frames": finer.frames, "points": len(finer.cloud.points_m), "stems": len(finer.stems), "not_measured": len(finer.unmeasured),
        "left_out_points": finer.left_out, "seconds": round(finer.seconds, 3),
    }}  # fmt: skip


def _vehicle_states(sequence: Path) -> Iterator[VehicleState]:
    """Yield what the autopilot said while an MCAP recording was made; slam levels its map by it as in the flight."""
    from services.recorder.reader import Recorded, messages

    if sequence.is_dir():
        return
    for entry in messages(sequence, (VEHICLE_STATE,)):
        if isinstance(entry, Recorded) and isinstance(entry.message, VehicleState):
            yield entry.message


def recorded_keyframes(sequence: Path) -> list[int]:
    """Return the stamps of the keyframes in an MCAP recording: of the same views the trees come out as in the flight."""
    from services.recorder.reader import Recorded, messages

    if sequence.is_dir():
        return []
    found = (entry.message for entry in messages(sequence, (SLAM_KEYFRAME,)) if isinstance(entry, Recorded))
    return [message.stamp_ns for message in found if isinstance(message, Keyframe)]


def result_files(
    title: str, result: OfflineResult, values: dict[str, Any], finer: FineResult | None = None
) -> dict[str, bytes]:
    """Return the contract's files by name, those for a GIS and for point-cloud programs, and those of the finer map."""
    stamp_ns = result.online[-1][0] if result.online else 0
    more, section = _finer_files(finer, result, stamp_ns)
    return more | {
        "trajectory.txt": exports.trajectory_bytes(result.trajectory),
        "trajectory_online.txt": exports.trajectory_bytes(result.online),
        "cloud.ply": exports.ply_bytes(result.points_m, result.rgb, result.seen),
        "trees.json": exports.trees_json(result.trees, "map"),
        "trees.csv": exports.trees_csv(result.trees),
        "trees.geojson": exports.trees_geojson(result.trees, "map"),
        "trees.gpkg": gis_exports.trees_gpkg(result.trees, stamp_ns),
        "cloud.laz": gis_exports.cloud_laz(result.points_m, result.rgb, stamp_ns),
        "targets.jsonl": exports.targets_jsonl(result.targets),
        "metrics.json": metrics_bytes(values),
        "report.html": report_bytes(
            f"treedock: {title}",
            values,
            result.trees,
            result.trajectory,
            result.points_m,
            sightings(result.targets),
            section,
        ),
    }


def _finer_files(
    finer: FineResult | None, result: OfflineResult, stamp_ns: int
) -> tuple[dict[str, bytes], list[str]]:  # fmt: skip
    """Return the finer map's files, and its section of the report."""
    if finer is None:
        return {}, []
    from services.evaluate.fine_files import fine_files
    from services.evaluate.fine_report import fine_section

    return fine_files(finer, stamp_ns), fine_section(finer, result.trees)


def _single_threaded() -> None:
    """OpenCV's threads and random numbers would make runs differ."""
    import cv2

    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
