"""The reference's Tables 4.1 to 4.5 on our scenes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.detector.config import DetectorConfig
from services.detector.detect import detect_trees
from services.detector.model import DetectionResult, Views
from services.detector.ransac_cylinder import detect_cylinders
from services.detector.reference import LEAF_M, LIMIT_M, PLANE_M, density_m, detect_reference, voxel_centroids
from services.evaluate.detection_accuracy import Detect, Tally, judged, ours
from services.evaluate.detection_clouds import SceneCloud
from services.evaluate.trees import rmse

UP = (0.0, 0.0, 1.0)
LEAVES_M = (0.001, 0.005, 0.01, 0.02, 0.03)
DISTANCES_M = (0.05, 0.1, 0.2)
_RADII_M = ((0.05, 0.035, 0.075), (0.10, 0.075, 0.125), (0.15, 0.125, 0.175), (0.20, 0.175, 0.225), (0.25, 0.225, 0.30))
METHODS: dict[str, Detect] = {
    "slicing (ours)": lambda scene: ours("multi")(scene),
    "slicing-reference": lambda scene: detect_reference(scene.points_m, UP),
    "cylinder": lambda scene: detect_cylinders(scene.points_m, UP),
}


@dataclass(frozen=True, slots=True)
class Counted:
    """A method over some scenes."""

    tally: Tally
    seconds: float
    """Mean per scene."""


def leaf_table(raw_m: NDArray[np.float32], views: Views) -> list[str]:
    """Table 4.1: leaf against density, thickness and time of the reference's method, and the trunks it then finds.

    Ours beside it takes the same raw points, (N, 3), with its voxels as wide as the leaf; warm.
    """
    lines = [
        "| voxel leaf (m) | points | density (m) | thickness (m) | time (s) | trunks | ours: time (s) | trunks |",
        "|---|---|---|---|---|---|---|---|",
    ]
    points_m = raw_m.astype(np.float64)
    for leaf in LEAVES_M:
        cloud = voxel_centroids(points_m, leaf)
        low = float(np.percentile(cloud[:, 2], 5.0))
        density = density_m(cloud[(cloud[:, 2] > low + PLANE_M) & (cloud[:, 2] < low + LIMIT_M)])
        begin = time.perf_counter()
        trunks = len(detect_reference(points_m, UP, leaf).trunks)
        seconds = time.perf_counter() - begin
        own, own_s = _ours_with(raw_m, views, DetectorConfig(voxel_m=leaf, map_drift_m=0.0))
        lines.append(
            f"| {leaf:g} | {len(cloud)} | {density:.4f} | {4 * density:.4f} | {seconds:.1f} | {trunks} | {own_s:.3f} | {own} |"
        )
    return lines


def _ours_with(points_m: NDArray[np.float32], views: Views, config: DetectorConfig) -> tuple[int, float]:
    """Return the number of trunks and the seconds of a second call."""
    for _ in range(2):
        begin = time.perf_counter()
        trunks = len(detect_trees(points_m, UP, views, config).trunks)
    return trunks, time.perf_counter() - begin


def points_per_layer(scenes: Iterable[SceneCloud], thickness_m: float = 0.0276) -> list[str]:
    """Table 4.2: points of a trunk in one layer of the reference's thickness, by radius (leaf 0.01 m)."""
    counts: dict[float, list[int]] = {radius: [] for radius, _, _ in _RADII_M}
    for scene in scenes:
        near = scene.points_m[np.abs(scene.points_m[:, 2] + 0.2) < 1.2]
        for tree in scene.trees:
            name = next((name for name, low, high in _RADII_M if low <= tree.radius_m < high), None)
            if name is None or not tree.fair:
                continue
            d = np.hypot(near[:, 0] - tree.x_m, near[:, 1] - tree.y_m)
            around = near[d < 1.6 * tree.radius_m + 0.1]
            own = voxel_centroids(around.astype(np.float64), LEAF_M) if len(around) else np.zeros((0, 3))
            counts[name] += [
                int(np.count_nonzero(np.abs(own[:, 2] - tree.z_m - height) < 0.5 * thickness_m))
                for height in (1.0, 1.2, 1.4)
            ]
    head = "| radius (cm) | " + " | ".join(f"{100 * name:g}" for name in counts) + " |"
    cells = [f"{np.mean(values):.0f}±{np.std(values):.0f}" if values else "none" for values in counts.values()]
    return [head, "|---" * (len(counts) + 1) + "|", "| points | " + " | ".join(cells) + " |"]


def count(scenes: Sequence[SceneCloud], detect: Detect) -> Counted:
    """Return what a method finds and its mean time."""
    total, seconds = Tally(), 0.0
    for scene in scenes:
        begin = time.perf_counter()
        result = detect(scene)
        seconds += time.perf_counter() - begin
        total.add(scene.name, *judged(scene, result))
    return Counted(total, seconds / max(len(scenes), 1))


def distance_table(scenes: Sequence[SceneCloud], tell: Callable[[str], None]) -> list[str]:
    """Table 4.3: what the clustering distance does to the reference's method; ours with its cells as wide beside it."""
    lines = [
        "| clustering distance (m) | found | false | ours with such cells: found | false |",
        "|---|---|---|---|---|",
    ]
    for distance in DISTANCES_M:

        def at(scene: SceneCloud, distance: float = distance) -> DetectionResult:
            return detect_reference(scene.points_m, UP, cluster_m=distance)

        def own_at(scene: SceneCloud, distance: float = distance) -> DetectionResult:
            return detect_trees(scene.points_m, UP, scene.views, DetectorConfig(link_m=distance, map_drift_m=0.0))

        total, own = count(scenes, at).tally, count(scenes, own_at).tally
        tell(f"clustering distance {distance:g} m: {total.found}/{total.suitable} found, {len(total.false)} false")
        lines.append(
            f"| {distance:g} | {total.found}/{total.suitable} | {len(total.false)} | {own.found}/{own.suitable} | {len(own.false)} |"
        )
    return lines


def method_table(
    single: Sequence[SceneCloud], multi: Sequence[SceneCloud], tell: Callable[[str], None]
) -> tuple[list[str], dict[str, float]]:
    """Tables 4.4 and 4.5: found, false and time of the three methods; figures of the baselines over all scenes."""
    lines = [
        "| method | single | multi | false (single, multi) | seconds a scene | centre RMSE (cm) | radius RMSE (cm) |",
        "|---|---|---|---|---|---|---|",
    ]
    figures: dict[str, float] = {}
    for name, detect in METHODS.items():
        one, many = count(single, detect), count(multi, detect)
        both = Tally()
        both.join(one.tally)
        both.join(many.tally)
        n = max(len(single) + len(multi), 1)
        seconds = (one.seconds * len(single) + many.seconds * len(multi)) / n
        lines.append(
            f"| {name} | {one.tally.found}/{one.tally.suitable} | {many.tally.found}/{many.tally.suitable} "
            f"| {len(one.tally.false)}, {len(many.tally.false)} | {seconds:.3f} "
            f"| {100 * rmse(both.centre_m):.1f} | {100 * rmse(both.radius_m):.1f} |"
        )
        tell(lines[-1])
        short = name.removeprefix("slicing-").removesuffix(" (ours)")
        figures |= {f"{short}_named_found": both.found, f"{short}_named_false": len(both.false)}
        figures["named_suitable"] = both.suitable
    return lines, figures
