"""Rings and ground after a turn on the spot: slam's keyframes of a simulated turn through the mapper, set up in several ways."""

from __future__ import annotations

import importlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.slam import Graph, Keyframe
from schemas.topics import SLAM_GRAPH, SLAM_KEYFRAME
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.memory import Hub
from services.evaluate.bench import BenchOptions, code_version
from services.evaluate.ring import MapPoints, Ring, ring_of
from services.evaluate.trees import read_truth
from services.mapper.service import MapperService

Floats = NDArray[np.float64]

_CODE = (
    "schemas", "services.common.geometry", "services.camera", "services.slam", "services.mapper", "services.simulator.scene",
    "services.simulator.planting", "services.simulator.sensor", "services.evaluate.ring", "services.evaluate.ring_turns",
)  # fmt: skip
TURN_FRAMES = 285
"""At 15 Hz: rest, rise, and the whole turn on the spot of the reference path."""
_NEAR_M = 5.0
"""Ground further away is seen too flat to say much."""


@dataclass(frozen=True, slots=True)
class Told:
    """What slam said over one sequence: keyframes and graphs in order."""

    messages: tuple[Keyframe | Graph, ...]


@dataclass(frozen=True, slots=True)
class GroundError:
    """The published ground against the scene's."""

    cells: int
    bias_m: float
    rmse_m: float
    """After the mean is taken off: slam's map may lie a little high or low."""
    slope_deg: float
    """RMS of the angle between the normals."""


@dataclass(frozen=True, slots=True)
class TurnResult:
    """One sequence with one set-up."""

    scene: str
    loop_closing: bool
    register: bool
    rings: tuple[Ring, ...]
    points: int
    ground: GroundError
    stage_ms: dict[str, float]
    """Medians."""
    accepted: int
    refused: int


@contextmanager
def rendered(name: str, options: BenchOptions) -> Iterator[Path]:
    """Give the folder of a turn through a scene: one kept from an earlier call, or rendered now (at half size)."""
    from services.simulator.catalogue import scene_by_name
    from services.simulator.write import write_sequence

    store = options.out / "turns"
    if (store / name / "truth.json").is_file():
        yield store / name
        return
    store.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{name}-", dir=store) as folder:
        sequence = Path(folder) / name
        write_sequence(scene_by_name(name), sequence, frames=TURN_FRAMES, reduced=True, seed=len(name))
        if options.keep_sequences:
            sequence = sequence.rename(store / name)
        yield sequence


def slam_says(sequence: Path, *, loop_closing: bool) -> Told:
    """Run slam alone and return what it told the mapper."""
    from services.camera.sources import open_recording
    from services.evaluate.offline import run_offline

    config = TreedockConfig()
    config = config.model_copy(update={"slam": config.slam.model_copy(update={"loop_closing": loop_closing})})
    heard: list[Keyframe | Graph] = []

    def tap(context: Context) -> None:
        context.on(SLAM_KEYFRAME, heard.append)
        context.on(SLAM_GRAPH, heard.append)

    slam = importlib.import_module("services.slam.service").build
    run_offline(open_recording(sequence, config.camera), config, builders={"slam": slam, "tap": tap})
    return Told(tuple(heard))


def mapped(told: Told, *, register: bool) -> tuple[MapperService, dict[str, list[float]], dict[str, int]]:
    """Send what slam said to a mapper; return it with the durations of its stages and its counters."""
    config = TreedockConfig()
    config = config.model_copy(update={"mapper": config.mapper.model_copy(update={"register_clouds": register})})
    hub = Hub(config)
    context, slam = hub.context("mapper"), hub.context("slam")
    mapper: MapperService = importlib.import_module("services.mapper.service").build(context)
    now_ns = 0
    for message in told.messages:
        slam.publish(SLAM_KEYFRAME if isinstance(message, Keyframe) else SLAM_GRAPH, message)
        hub.run()
        now_ns += 200_000_000
        hub.advance_to(now_ns)
    hub.advance_to(now_ns + 2_000_000_000)
    return mapper, context.health.stage_ms, context.health.counters


def measured(sequence: Path, told: Told, *, loop_closing: bool, register: bool) -> TurnResult:
    """Map a turn and measure it against the truth beside the sequence."""
    mapper, stage_ms, counters = mapped(told, register=register)
    cloud = map_points(mapper)
    trees = [t for t in read_truth(sequence / "truth.json") if t.suitable and t.fair]
    rings = [ring for tree in trees if (ring := ring_of(cloud, tree)) is not None]
    return TurnResult(
        scene=sequence.name, loop_closing=loop_closing, register=register, rings=tuple(rings), points=mapper.map.size,
        ground=ground_error(mapper, sequence.name), stage_ms={k: float(np.median(v)) for k, v in stage_ms.items() if v},
        accepted=counters.get("registered", 0), refused=counters.get("not_registered", 0),
    )  # fmt: skip


def map_points(mapper: MapperService) -> MapPoints:
    """Return the whole map with the keyframe of each point."""
    points, keyframes = [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    for s in mapper.map.submaps.values():
        T = s.T_map_submap
        points.append(s.points_m.astype(np.float64) @ T[:3, :3].T + T[:3, 3])
        keyframes.append(np.full(len(s.points_m), s.submap_id))
    return MapPoints(np.concatenate(points), np.concatenate(keyframes))


def ground_error(mapper: MapperService, scene_name: str) -> GroundError:
    """Compare the cells around the start with the scene's ground."""
    from services.simulator.catalogue import scene_by_name
    from services.simulator.path import map_frame, reference_path, sample
    from services.simulator.world import World

    scene = scene_by_name(scene_name)
    T = map_frame(sample(reference_path(scene, None, World(scene).clearance), 15.0, 1)[0][1])
    model = mapper.ground
    heights, angles = [], []
    for (column, row), plane in model.cells.items():
        x, y = (column + 0.5) * model.cell_m, (row + 0.5) * model.cell_m
        if np.hypot(x, y) > _NEAR_M:
            continue
        at = (T @ [x, y, plane.height_m, 1.0])[:3]
        heights.append(at[2] - scene.ground.at(at[0], at[1]))
        normal = T[:3, :3] @ np.array([-plane.slope_x, -plane.slope_y, 1.0])
        true = _normal(scene.ground.height, at[0], at[1])
        cosine = float(normal @ true) / float(np.linalg.norm(normal) * np.linalg.norm(true))
        angles.append(np.degrees(np.arccos(min(1.0, cosine))))
    if not heights:
        return GroundError(0, float("nan"), float("nan"), float("nan"))
    return GroundError(
        len(heights), float(np.mean(heights)), float(np.std(heights)), float(np.sqrt(np.mean(np.square(angles))))
    )


def _normal(height: object, x: float, y: float, h: float = 0.1) -> Floats:
    dx = (height(x + h, y) - height(x - h, y)) / (2 * h)  # type: ignore[operator]
    dy = (height(x, y + h) - height(x, y - h)) / (2 * h)  # type: ignore[operator]
    return np.array([-float(dx), -float(dy), 1.0])


def turns(names: Sequence[str], options: BenchOptions) -> list[TurnResult]:
    """Do every scene with and without loop closing and registration; what an earlier call did is not done again."""
    results = []
    code = code_version(_CODE)[:8]
    for name in names:
        kept = options.out / "mapper" / f"{name}-{code}.json"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps([asdict(r) for r in _turn(name, options)]))
        for body in json.loads(kept.read_text()):
            result = _read(body)
            options.tell(line_of(result))
            results.append(result)
    return results


def _turn(name: str, options: BenchOptions) -> list[TurnResult]:
    results = []
    with rendered(name, options) as sequence:
        for loop_closing in (True, False):
            told = slam_says(sequence, loop_closing=loop_closing)
            results += [
                measured(sequence, told, loop_closing=loop_closing, register=register) for register in (False, True)
            ]
    return results


def _read(body: dict[str, Any]) -> TurnResult:
    rings = tuple(Ring(**{**ring, "centre_m": tuple(ring["centre_m"])}) for ring in body["rings"])
    return TurnResult(**{**body, "rings": rings, "ground": GroundError(**body["ground"])})


def line_of(r: TurnResult) -> str:
    """Return a result as one line."""
    how = f"loops {'closed' if r.loop_closing else 'open'}, registration {'on' if r.register else 'off'}"
    rings = ", ".join(
        f"{100 * g.thickness_m:.2f} cm thick {100 * g.view_spread_m:.2f} apart {100 * g.doubled_share:.0f} % doubled"
        for g in r.rings
    )
    return f"{r.scene}, {how}: {len(r.rings)} rings: {rings}"
