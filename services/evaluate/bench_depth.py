"""What each stage of the depth pipeline gains on simulated depth with truth: error, holes, mixed pixels, time."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from services.camera.codecs import encode_depth
from services.camera.conditioning import Conditioner
from services.camera.config import CameraConfig
from services.camera.depth.config import DepthConfig
from services.camera.depth.geometry import register, undistort_depth
from services.camera.depth.pipeline import DepthPipeline, warm
from services.evaluate import depth_filters
from services.evaluate.bench import BenchOptions, BenchReport
from services.evaluate.depth_views import BentShot, PairShot, Shot, around, at_rest, bent, beside, turning

Image = NDArray[np.float32]
Grey = NDArray[np.uint8]
Method = Callable[[Image, Grey], Image]

FRAMES = 12
_MAX_RANGE_M = 6.0
_EDGE_PX = 7
_EDGE_STEP_M = 0.3
_OFF = DepthConfig(drop_mixed=False, bilateral=False, fill_holes=False, temporal=False)
_ALL = _OFF.model_copy(update={"drop_mixed": True, "bilateral": True, "fill_holes": True})
_WARM_UP = 5
_TIMED = 3
"""Times that each view is conditioned for the timing."""


@dataclass(frozen=True, slots=True)
class Row:
    """A method's figures over all shots."""

    name: str
    rmse_m: float
    """Of all pixels with data; beside an edge, against the nearer of the two surfaces."""
    inner_rmse_m: float
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
    seed = options.seed or 0
    shots = list(around(seed, 3 if options.quick else FRAMES))
    rows = []
    for name, make in methods().items():
        rows.append(measure(name, make, shots))
        options.tell(_line(rows[-1]))
    moving = _moving_rows(seed)
    for row in moving:
        options.tell(_line(row))
    geometry = [*undistortion(bent(shots[0])), *registration(beside(seed))]
    timing = {name: timed(config, shots) for name, config in {"default": DepthConfig(), "all": _every()}.items()}
    by_name = {row.name: row for row in rows}
    conditions = {
        "sensor": "640x480, disparity noise s 0.08 px (40 % of it a fixed pattern), 5 px mixed pixels, shadow holes",
        "scenes": f"{len(shots)} views of fresh multi, undergrowth and slope scenes", "seed": str(seed),
        "default": told(DepthConfig()),
    }  # fmt: skip
    return BenchReport(_figures(by_name, timing), conditions, _table(rows, moving, geometry, timing))


def methods() -> dict[str, Callable[[], Method]]:
    """Return the methods to compare; each call of a value gives a fresh one."""

    def stages(**on: bool) -> Callable[[], Method]:
        return _pipeline(_OFF.model_copy(update=on))

    return {
        "raw (range only)": _pipeline(_OFF),
        "box 5x5": lambda: depth_filters.box,
        "mean of valid 5x5": lambda: depth_filters.mean,
        "Gaussian 5x5": lambda: depth_filters.gaussian,
        "median 5x5": lambda: depth_filters.median,
        "mixed pixels dropped": stages(drop_mixed=True),
        "bilateral": stages(bilateral=True),
        "holes filled": stages(fill_holes=True),
        "mixed dropped + bilateral": stages(drop_mixed=True, bilateral=True),
        "mixed dropped + bilateral + holes filled": _pipeline(_ALL),
        "default": _pipeline(DepthConfig()),
    }


def told(config: DepthConfig) -> str:
    """Return the stages that a configuration has on, in words."""
    names = {
        "undistort": "undistortion", "drop_mixed": "mixed pixels dropped", "bilateral": "bilateral",
        "fill_holes": "holes filled", "temporal": "temporal",
    }  # fmt: skip
    return ", ".join(["range", *(word for name, word in names.items() if getattr(config, name))])


def _every() -> DepthConfig:
    return _ALL.model_copy(update={"temporal": True})


def _moving_rows(seed: int) -> list[Row]:
    """Measure the temporal filter on a camera at rest, where it should help, and on one that turns."""
    rows = []
    for name, shots in (("at rest", at_rest(seed)), ("turning 30 deg/s", turning(seed))):
        for temporal in (False, True):
            config = _OFF.model_copy(update={"drop_mixed": True, "temporal": temporal})
            label = f"{name}: mixed dropped" + (" + temporal" if temporal else "")
            rows.append(measure(label, _pipeline(config), shots, warm_up=_WARM_UP))
    return rows


def _pipeline(config: DepthConfig) -> Callable[[], Method]:
    def make() -> Method:
        pipeline = DepthPipeline(config, (480, 640))
        return lambda depth, grey: pipeline.process(depth, grey).depth_m

    return make


def measure(name: str, make: Callable[[], Method], shots: Sequence[Shot], warm_up: int = 0) -> Row:
    """Return a method's figures; ``warm_up``: shots shown first, not measured."""
    method = make()
    sums = np.zeros(8)
    times = []
    for number, shot in enumerate(shots):
        begin = time.thread_time()
        out = method(shot.sensed, shot.grey)
        if number < warm_up:
            continue
        times.append((time.thread_time() - begin) * 1e3)
        sums += _sums(out, shot.true)
    inner, inner_n, edge, edge_n, holes, inside, mixed, wrong = sums
    return Row(
        name, float(np.sqrt((inner + edge) / max(inner_n + edge_n, 1))), float(np.sqrt(inner / max(inner_n, 1))),
        float(np.sqrt(edge / max(edge_n, 1))), float(holes / inside), float(mixed / max(edge_n, 1)),
        float(wrong / max(inner_n + edge_n, 1)), float(np.median(times)),
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
    inner, outer = data & ~edge, (out > 0) & edge
    error = np.where(edge, either, plain)
    return np.array([
        plain[inner].sum(), inner.sum(), either[outer].sum(), outer.sum(), (inside & (out == 0)).sum(), inside.sum(),
        (between & outer).sum(), (np.sqrt(error) > 0.1)[inner | outer].sum(),
    ], dtype=np.float64)  # fmt: skip


def undistortion(shot: BentShot) -> list[tuple[str, float]]:
    """Return how far points are from the truth across the line of sight, the lens ignored and corrected (median, m)."""
    camera = shot.camera
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    plain = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    good = np.isfinite(shot.points_m[..., 2]) & (shot.points_m[..., 2] > 0.5) & (shot.points_m[..., 2] < _MAX_RANGE_M)
    points = np.where(good[..., None], shot.points_m, 0.0)
    z = points[..., 2]
    ignored = np.linalg.norm(plain * z[..., None] - points[..., :2], axis=-1)[good]
    # after resampling, pixel (u, v) holds what the bent camera saw of the plain ray; its own true ray tells the rest
    rays = (points[..., :2] / np.maximum(z, 1e-6)[..., None]).astype(np.float32)
    moved = [undistort_depth(np.ascontiguousarray(part), camera) for part in (rays[..., 0], rays[..., 1])]
    depth = undistort_depth(z.astype(np.float32), camera)
    left = np.hypot(moved[0] - plain[..., 0], moved[1] - plain[..., 1]) * depth
    return [
        ("lens of freiburg1 ignored: points off by", float(np.median(ignored))),
        ("undistorted (nearest pixel): points off by", float(np.median(left[depth > 0]))),
    ]


def registration(shot: PairShot) -> list[tuple[str, float]]:
    """Return the share of pixels more than 0.3 m off the truth in the colour image, without and with registration."""
    moved = register(depth_filters.limited(shot.sensed), shot.camera, shot.camera, shot.T_colour_depth)

    def off(depth: Image) -> float:
        both = (depth > 0) & (shot.true > 0.5) & (shot.true < _MAX_RANGE_M)
        return float(np.mean(np.abs(depth - shot.true)[both] > _EDGE_STEP_M))

    return [
        (
            "depth camera 5.8 cm beside, not registered: share of pixels off > 0.3 m",
            off(depth_filters.limited(shot.sensed)),
        ),
        ("registered: share of pixels off > 0.3 m", off(moved)),
    ]


def timed(config: DepthConfig, shots: Sequence[Shot]) -> dict[str, float]:
    """Return milliseconds from frame to frame as in the service.

    ``total``: median CPU time of the whole; each stage: least wall time, so that a busy machine does not show in it.
    """
    conditioner = Conditioner(CameraConfig(depth=config))
    stages: dict[str, list[float]] = {}
    for number, shot in enumerate([shots[0], *list(shots) * _TIMED]):
        frame = _frame(shot, number)
        begin = time.thread_time()
        conditioner.apply(frame)
        total = (time.thread_time() - begin) * 1e3
        if number == 0:
            continue
        for stage, ms in {**conditioner.stage_ms, "total": total}.items():
            stages.setdefault(stage, []).append(ms)
    return {stage: float(np.median(ms) if stage == "total" else np.min(ms)) for stage, ms in stages.items()}


def _frame(shot: Shot, seq: int) -> RgbdFrame:
    from services.simulator.render import DEFAULT_INTRINSICS

    colour = np.repeat(shot.grey[:, :, None], 3, axis=2).tobytes()
    depth = encode_depth(np.rint(shot.sensed * 1000.0).astype(np.uint16), "z16")
    return RgbdFrame(seq, seq, DEFAULT_INTRINSICS, colour, depth)


def _figures(by_name: Mapping[str, Row], timing: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    raw, out, everything = (
        by_name["raw (range only)"],
        by_name["default"],
        by_name["mixed dropped + bilateral + holes filled"],
    )
    figures = {"pipeline_ms_p50": timing["default"]["total"], "all_stages_ms_p50": timing["all"]["total"]}
    for name, row in (("raw", raw), ("out", out), ("all", everything)):
        figures |= {
            f"rmse_{name}_m": row.rmse_m, f"inner_rmse_{name}_m": row.inner_rmse_m, f"edge_rmse_{name}_m": row.edge_rmse_m,
            f"holes_{name}": row.holes, f"mixed_{name}": row.mixed,
        }  # fmt: skip
    return {name: round(value, 5) for name, value in figures.items()}


def _line(row: Row) -> str:
    return (
        f"{row.name}: rmse {1000 * row.rmse_m:.1f} mm, away from edges {1000 * row.inner_rmse_m:.1f}, at edges "
        f"{1000 * row.edge_rmse_m:.0f}, holes {100 * row.holes:.2f} %, mixed {100 * row.mixed:.2f} %, {row.ms:.1f} ms"
    )


def _table(
    rows: Sequence[Row], moving: Sequence[Row], geometry: Sequence[tuple[str, float]],
    timing: Mapping[str, Mapping[str, float]],
) -> str:  # fmt: skip
    head = [
        "| method | rmse (mm) | away from edges (mm) | at edges (mm) | holes (%) | mixed pixels (%) | off > 10 cm (%) | ms |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines = [*head, *map(_cells, rows), "", "The temporal filter, camera at rest and turning:", "", *head]
    lines += [*map(_cells, moving), "", "Geometry:", "", "| what | |", "|---|---|"]
    for what, value in geometry:
        lines.append(f"| {what} | {f'{100 * value:.2f} %' if 'share' in what else f'{1000 * value:.1f} mm'} |")
    lines += [
        "",
        "Milliseconds a frame, 640x480, one thread:",
        "",
        "| stages | total, median | each, least |",
        "|---|---|---|",
    ]
    for name, stages in timing.items():
        each = ", ".join(f"{stage} {ms:.2f}" for stage, ms in stages.items() if stage != "total")
        lines.append(f"| {name} | {stages['total']:.1f} | {each} |")
    return "\n".join(lines)


def _cells(r: Row) -> str:
    return (
        f"| {r.name} | {1000 * r.rmse_m:.1f} | {1000 * r.inner_rmse_m:.1f} | {1000 * r.edge_rmse_m:.0f} "
        f"| {100 * r.holes:.2f} | {100 * r.mixed:.2f} | {100 * r.wrong:.2f} | {r.ms:.1f} |"
    )
