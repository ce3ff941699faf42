"""What each depth filter gains on simulated depth with truth: error, holes, mixed pixels, time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.camera.depth.config import DepthConfig
from services.camera.depth.pipeline import DepthPipeline, warm
from services.evaluate.bench import BenchOptions, BenchReport

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]
Method = Callable[[Image, Grey], Image]

FRAMES = 12
_MAX_RANGE_M = 6.0
_EDGE_PX = 7
_EDGE_STEP_M = 0.3
_ALL = DepthConfig(drop_mixed=True, bilateral=True, fill_holes=True)


@dataclass(frozen=True, slots=True)
class Shot:
    """A true and a sensed depth image (H, W) in metres, and the grey image."""

    true: Image
    sensed: Image
    grey: Grey


@dataclass(frozen=True, slots=True)
class Row:
    """A method's figures over all shots."""

    name: str
    rmse_m: float
    """Of pixels away from depth edges."""
    edge_rmse_m: float
    holes: float
    """Share of pixels within range without data."""
    mixed: float
    """Share of pixels at depth edges that hang between the two surfaces."""
    wrong: float
    """Share of pixels off by more than 10 cm."""
    ms: float


def run(options: BenchOptions) -> BenchReport:
    """Compare the pipeline and its stages with box, mean, Gaussian and median filters."""
    import cv2

    cv2.setNumThreads(1)
    warm()
    shots = list(_shots(options.seed or 0, 3 if options.quick else FRAMES))
    rows = []
    for name, make in methods().items():
        rows.append(measure(name, make, shots))
        options.tell(_line(rows[-1]))
    still = _still(options.seed or 0)
    for temporal in (False, True):
        config = _ALL.model_copy(update={"temporal": temporal})
        name = "still camera, pipeline" + (" + temporal" if temporal else "")
        rows.append(measure(name, _pipeline(config), still, warm_up=6))
        options.tell(_line(rows[-1]))
    by_name = {row.name: row for row in rows}
    raw, out = by_name["raw"], by_name["pipeline"]
    figures = {
        "pipeline_ms_p50": out.ms, "rmse_raw_m": raw.rmse_m, "rmse_out_m": out.rmse_m,
        "edge_rmse_raw_m": raw.edge_rmse_m, "edge_rmse_out_m": out.edge_rmse_m, "holes_raw": raw.holes,
        "holes_out": out.holes, "mixed_raw": raw.mixed, "mixed_out": out.mixed,
    }  # fmt: skip
    conditions = {
        "sensor": "640x480, disparity noise s 0.08 px (40 % of it a fixed pattern), 5 px mixed pixels, shadow holes",
        "scenes": f"{len(shots)} views of fresh multi, undergrowth and slope scenes", "seed": str(options.seed or 0),
    }  # fmt: skip
    return BenchReport(figures, conditions, _table(rows))


def methods() -> dict[str, Callable[[], Method]]:
    """Return the methods to compare; each call of a value gives a fresh one."""
    off = DepthConfig(drop_mixed=False, bilateral=False, fill_holes=False)
    return {
        "raw": _pipeline(off),
        "box 5x5": lambda: _box,
        "mean of valid 5x5": lambda: _mean,
        "Gaussian 5x5": lambda: _gaussian,
        "median 5x5": lambda: _median,
        "bilateral": _pipeline(off.model_copy(update={"bilateral": True})),
        "mixed pixels dropped": _pipeline(off.model_copy(update={"drop_mixed": True})),
        "holes filled": _pipeline(off.model_copy(update={"fill_holes": True})),
        "bilateral + mixed dropped": _pipeline(off.model_copy(update={"bilateral": True, "drop_mixed": True})),
        "pipeline": _pipeline(_ALL),
    }


def _pipeline(config: DepthConfig) -> Callable[[], Method]:
    def make() -> Method:
        pipeline = DepthPipeline(config, (480, 640))
        return lambda depth, grey: pipeline.process(depth, grey).depth_m

    return make


def _limited(depth: Image) -> Image:
    return np.where((depth >= 0.5) & (depth <= _MAX_RANGE_M), depth, np.float32(0.0))


def _box(depth: Image, grey: Grey) -> Image:
    """Plain box filter: holes count as zero metres, as a filter that knows nothing of depth has it."""
    import cv2

    del grey
    depth = _limited(depth)
    return np.where(depth > 0, np.asarray(cv2.blur(depth, (5, 5))), np.float32(0.0))


def _mean(depth: Image, grey: Grey) -> Image:
    """Return the mean of the valid pixels in the window, where at least half of them are valid."""
    import cv2

    del grey
    depth = _limited(depth)
    share = np.asarray(cv2.blur((depth > 0).astype(np.float32), (5, 5)))
    return np.where(share > 0.5, np.asarray(cv2.blur(depth, (5, 5))) / np.maximum(share, 0.04), np.float32(0.0))


def _gaussian(depth: Image, grey: Grey) -> Image:
    """Gaussian filter of the valid pixels."""
    import cv2

    del grey
    depth = _limited(depth)
    share = np.asarray(cv2.GaussianBlur((depth > 0).astype(np.float32), (5, 5), 1.1))
    smooth = np.asarray(cv2.GaussianBlur(depth, (5, 5), 1.1))
    return np.where(share > 0.5, smooth / np.maximum(share, 0.01), np.float32(0.0))


def _median(depth: Image, grey: Grey) -> Image:
    import cv2

    del grey
    return np.asarray(cv2.medianBlur(_limited(depth), 5), dtype=np.float32)


def measure(name: str, make: Callable[[], Method], shots: Sequence[Shot], warm_up: int = 0) -> Row:
    """Return a method's figures; ``warm_up``: shots shown first, not measured."""
    method = make()
    sums = np.zeros(8)
    times = []
    for number, shot in enumerate(shots):
        begin = time.perf_counter()
        out = method(shot.sensed, shot.grey)
        if number < warm_up:
            continue
        times.append((time.perf_counter() - begin) * 1e3)
        sums += _sums(out, shot.true)
    inner, edge = sums[0] / max(sums[1], 1), sums[2] / max(sums[3], 1)
    return Row(
        name, float(np.sqrt(inner)), float(np.sqrt(edge)), float(sums[4] / sums[5]), float(sums[6] / max(sums[3], 1)),
        float(sums[7] / max(sums[1] + sums[3], 1)), float(np.median(times)),
    )  # fmt: skip


def _sums(out: Image, true: Image) -> NDArray[np.float64]:
    """Squared errors and counts: inner, edge; holes and pixels; mixed; wrong."""
    import cv2

    near = np.minimum(true, 30.0).astype(np.float32)
    window = np.ones((_EDGE_PX, _EDGE_PX), np.uint8)
    low, high = np.asarray(cv2.erode(near, window)), np.asarray(cv2.dilate(near, window))
    edge = high - low > _EDGE_STEP_M
    inside = (true >= 0.5) & (true <= _MAX_RANGE_M)
    data = (out > 0) & inside
    # a pixel beside an edge may show either surface; how far it is from the nearer one is its error
    plain = np.square(out - near)
    either = np.minimum(plain, np.minimum(np.square(out - low), np.square(out - high)))
    tolerance = 0.05 + 0.01 * near**2
    between = (out > low + tolerance) & (out < high - tolerance) & (np.abs(out - near) > tolerance)
    anywhere = (out > 0) & edge
    inner, outer = data & ~edge, anywhere
    return np.array([
        plain[inner].sum(), inner.sum(), either[outer].sum(), outer.sum(), (inside & (out == 0)).sum(), inside.sum(),
        (between & outer).sum(), (np.sqrt(either) > 0.1)[inner | outer].sum(),
    ], dtype=np.float64)  # fmt: skip


def _shots(seed: int, count: int) -> Iterator[Shot]:
    """Yield views all round fresh scenes."""
    from services.common.geometry import level_camera

    kinds = ("multi", "undergrowth", "slope")
    for k in range(count):
        kind = kinds[k % len(kinds)]
        yield from _look(f"random-{kind}-{51_000 + seed}", [level_camera((0.0, 0.0, 1.5), 2.0 * np.pi * k / count)], k)


def _still(seed: int) -> list[Shot]:
    from services.common.geometry import level_camera

    return list(_look(f"random-multi-{52_000 + seed}", [level_camera((0.0, 0.0, 1.5), 0.0)] * 10, 0))


def _look(scene_name: str, poses: Sequence[NDArray[np.float64]], first: int) -> Iterator[Shot]:
    import cv2

    from services.simulator.catalogue import scene_by_name
    from services.simulator.config import SensorConfig
    from services.simulator.render import DEFAULT_INTRINSICS, Renderer
    from services.simulator.sensor import RgbdSensor
    from services.simulator.world import World

    scene = scene_by_name(scene_name)
    renderer = Renderer(World(scene), DEFAULT_INTRINSICS)
    sensor = RgbdSensor(SensorConfig(), (480, 640))
    for k, T in enumerate(poses):
        lifted = T.copy()
        lifted[2, 3] += scene.ground.at(0.0, 0.0)
        rendering = renderer.render(lifted)
        true = rendering.depth_m.copy()
        images = sensor.expose(rendering, first + k)
        grey = np.asarray(cv2.cvtColor(images.colour, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        yield Shot(true, images.depth.astype(np.float32) / np.float32(1000.0), grey)


def _line(row: Row) -> str:
    return (
        f"{row.name}: rmse {1000 * row.rmse_m:.1f} mm, at edges {1000 * row.edge_rmse_m:.0f} mm, "
        f"holes {100 * row.holes:.2f} %, mixed {100 * row.mixed:.2f} %, {row.ms:.1f} ms"
    )


def _table(rows: Sequence[Row]) -> str:
    lines = [
        "| method | rmse (mm) | rmse at edges (mm) | holes (%) | mixed pixels (%) | off > 10 cm (%) | ms |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.name} | {1000 * r.rmse_m:.1f} | {1000 * r.edge_rmse_m:.0f} | {100 * r.holes:.2f} "
        f"| {100 * r.mixed:.2f} | {100 * r.wrong:.2f} | {r.ms:.1f} |"
        for r in rows
    ]
    return "\n".join(lines)
