"""The clouds on which ours and the peers are compared, and what stands in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.mapping import Submap
from schemas.simulation import TrueTree
from services.detector.map_store import MapStore
from services.detector.model import Views
from services.evaluate.bench import BenchOptions
from services.evaluate.bench_peers import PeerCloud, Stem
from services.evaluate.detection_clouds import keyframe_points, scene_cloud
from services.evaluate.ring import fit_centre

_NAN = float("nan")

HILL: tuple[Stem, ...] = tuple((x, -z, _NAN) for x, z in (
    (-0.07, 0.76), (0.60, 2.22), (2.40, 2.11), (-4.18, -0.57), (4.10, -0.62), (-5.93, 0.41), (5.59, -0.47), (-6.67, -1.86),
    (6.65, 0.66), (7.56, -1.90), (8.45, -3.10),
))  # fmt: skip
"""iLiDAR_trees_on_hill turned so that z is up; by eye, docs/clouds.md."""
SQUARE: tuple[Stem, ...] = tuple((x, y, _NAN) for x, y in (
    (5.46, 2.16), (5.48, 5.06), (8.34, 2.27), (2.72, 8.31), (5.59, 8.28), (2.59, 11.23), (8.71, 8.29), (5.72, 11.20),
    (11.6, 5.3), (11.48, 8.25), (8.67, 11.21), (14.30, 2.18), (2.80, 14.38), (5.75, 14.2), (11.57, 11.27), (8.72, 14.38),
    (2.90, 17.11), (5.82, 17.12), (17.39, 5.05), (14.55, 11.25), (8.75, 17.13), (17.54, 8.31), (14.70, 14.26),
    (11.77, 17.15), (17.5, 11.22), (14.62, 17.23), (17.64, 14.27), (2.66, 5.37), (2.40, 2.42),
))  # fmt: skip
"""TreeLS_square, stems wholly inside the plot."""
SQUARE_CUT: tuple[Stem, ...] = ((-0.05, 14.45, 0.3), (0.0, 17.15, 0.3))
"""Slivers of bark of stems that the border cuts."""
FDS: tuple[Stem, ...] = ((-6.69, 6.49, _NAN), (-12.70, 7.04, _NAN), (-6.11, 14.29, _NAN), (-12.85, 12.41, _NAN))
GROUNDLESS = ("TreeLS_square", "TLS_to_FDS_test_trunks")
PINE_RADIUS_M = 0.253 / 2


def simulated_cloud(name: str, options: BenchOptions) -> PeerCloud:
    """Return the map of a simulated turn, and its trees at breast height; kept for later calls under ``options.out``."""
    kept = options.out / "peers" / f"{name}.npz"
    if not kept.exists():
        kept.parent.mkdir(parents=True, exist_ok=True)
        _make(name, kept, options)
    with np.load(kept) as body:
        views = Views(
            body["index"], body["origins_m"], body["rotations"], (float(body["tan"][0]), float(body["tan"][1]))
        )
        points, fair, unfair = body["points_m"], _stems(body["fair"]), _stems(body["unfair"])
    return PeerCloud(name, points, fair, views, ignored=unfair)


def _make(name: str, file: Path, options: BenchOptions) -> None:
    from services.evaluate.ring_turns import mapped, rendered, slam_says
    from services.evaluate.trees import read_truth

    with rendered(name, options) as sequence:
        mapper, _, _ = mapped(slam_says(sequence, loop_closing=True), register=False)
        trees = read_truth(sequence / "truth.json")
    store = MapStore()
    for submap in mapper.whole_map():
        if isinstance(submap, Submap):
            store.take(submap)
    points, views = store.assemble()
    fair = [t for t in trees if t.fair and t.suitable]
    unfair = [t for t in trees if not (t.fair and t.suitable)]
    np.savez(
        file, points_m=points.astype(np.float64), index=views.index, origins_m=views.origins_m,
        rotations=views.rotations if views.rotations is not None else np.zeros((0, 3, 3)), tan=views.tan_half or (0.0, 0.0),
        fair=_at_breast(fair), unfair=_at_breast(unfair),
    )  # fmt: skip


def whole_cloud(name: str, options: BenchOptions) -> PeerCloud:
    """Return all points of the scene's keyframes at their true poses, full resolution, nothing thinned; and its trees."""
    cache = options.out / "detection"
    points, views = keyframe_points(name, cache)
    trees = scene_cloud(name, cache).trees
    fair = [t for t in trees if t.fair and t.suitable]
    unfair = [t for t in trees if not (t.fair and t.suitable)]
    return PeerCloud(f"{name}-whole", points.astype(np.float64), _at_breast(fair), views, ignored=_at_breast(unfair))


def _stems(rows: NDArray[np.float64]) -> tuple[Stem, ...]:
    return tuple((float(x), float(y), float(r)) for x, y, r in rows.reshape(-1, 3))


def _at_breast(trees: Sequence[TrueTree]) -> tuple[Stem, ...]:
    return tuple((t.x_m + 1.3 * t.axis[0] / t.axis[2], t.y_m + 1.3 * t.axis[1] / t.axis[2], t.radius_m) for t in trees)


def real_clouds(folder: Path, tell: Callable[[str], None]) -> Iterator[PeerCloud]:
    """Yield the recorded clouds that are there."""
    from services.detector.readers import read_cloud

    up_is_y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for name, stems, ignored, turn in (
        ("TreeLS_pine", (), (), None), ("TreeLS_square", SQUARE, SQUARE_CUT, None),
        ("TLS_to_FDS_test_trunks", FDS, (), None), ("iLiDAR_trees_on_hill", HILL, (), up_is_y),
    ):  # fmt: skip
        file = folder / f"{name}.laz"
        if not file.is_file():
            tell(f"{file} is absent: left out (--data names the folder of recordings)")
            continue
        points = read_cloud(file).points_m
        points = points if turn is None else points @ turn.T
        if name == "TreeLS_pine":
            low = points[np.abs(points[:, 2] - points[:, 2].min() - 1.3) < 0.1, :2]
            middle = np.median(low, axis=0)
            x, y = fit_centre(low - middle, PINE_RADIUS_M, 0.3)
            stems = ((float(middle[0]) + x, float(middle[1]) + y, PINE_RADIUS_M),)
        groundless = name in GROUNDLESS
        yield PeerCloud(name, points, tuple(stems), groundless=groundless, ignored=tuple(ignored))
