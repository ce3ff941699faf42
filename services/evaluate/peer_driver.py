"""Runs one peer on one cloud, in the peers' own environment: ``python peer_driver.py NAME CLOUD.npz OUT.json``.

Stands alone: nothing of treedock is imported, since none of it is installed there. The cloud (N, 3) has z up.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import inspect
import json
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = list[list[float]]
"""x, y, radius of each stem."""


DENDROMATICS: dict[str, dict[str, float]] = {
    "3DFin's defaults": {},
    "for thinned clouds of one side": {"n_points": 150, "section_points": 30, "sectors": 5},
    "and for noise": {
        "n_points": 150, "section_points": 30, "sectors": 5, "scale": 0.2, "threshold": 0.6, "voxel_m": 0.03,
    },
}  # fmt: skip
"""Settings of 3DFin, dendromatics' own application; what differs from its defaults. The second: fewer points a stem and a section, and
5 of 16 sectors instead of 9, since a camera sees less than half of a trunk. The third: wider and laxer verticality as well."""
_SECTIONS_M = (0.3, 25.0, 0.2)
_STRIPE_M = (0.7, 3.5)


def dendromatics(points: Floats, settings: str) -> Rows:
    """Find stems as 3DFin drives the package: its order of steps, its defaults (abstract_processing.py, configuration.py)."""
    dm = importlib.import_module("dendromatics")
    own = {
        "n_points": 1000,
        "section_points": 80,
        "sectors": 9,
        "scale": 0.1,
        "threshold": 0.7,
        "voxel_m": 0.02,
    } | DENDROMATICS[settings]
    terrain = dm.clean_cloth(dm.generate_dtm(dm.clean_ground(points), cloth_resolution=0.7))
    heights = dm.normalize_heights(points, terrain)
    cloud = np.column_stack([points, heights])

    def upright(part: Floats) -> Floats:
        return dm.verticality_clustering(
            part, own["scale"], own["threshold"], int(own["n_points"]), 2, own["voxel_m"], own["voxel_m"], 5
        )  # fmt: skip

    stripe = upright(cloud[(heights > _STRIPE_M[0]) & (heights < _STRIPE_M[1])])
    assigned, vectors = dm.individualize_trees(
        cloud, stripe, resolution_z=0.035, resolution_xy=0.035, stripe_lower_limit=_STRIPE_M[0], stripe_upper_limit=_STRIPE_M[1],
        h_range=0.7, d_max=15.0, min_points=20, d=1.5, max_dev=25.0, resolution_heights=0.3,
    )[:2]  # fmt: skip
    low, high, step = _SECTIONS_M
    stems = upright(assigned[(assigned[:, 5] < 1.0) & (assigned[:, 3] > low) & (assigned[:, 3] < high)])[:, :6]
    sections = np.arange(low, min(high, float(heights.max()) + step), step)
    x, y, radius, _, _, occupied, _ = dm.compute_sections(
        stems, sections, section_width=0.05, R_min=0.03, R_max=0.5, n_points_section=int(own["section_points"]),
        min_n_sectors=int(own["sectors"]), width=0.02,
    )  # fmt: skip
    outliers = dm.tilt_detection(x, y, radius, sections, w_1=3, w_2=1)
    diameters, places = dm.tree_locator(sections, x, y, vectors, occupied, radius, outliers)
    rows = []
    for place, diameter, found in zip(places, np.ravel(diameters), radius, strict=True):
        good = found[found > 0]
        r = diameter / 2 if diameter > 0 else (float(np.median(good)) if len(good) else 0.0)
        rows.append([float(place[0]), float(place[1]), float(r)])
    return rows


TREEX = ("TreeXPreset", "TreeXPresetOriginal", "TreeXPresetULS")
"""The author's presets: default (which is the one for terrestrial scans), the paper's, and for sparser clouds."""


def treex(points: Floats, settings: str) -> Rows:
    """Find stems with treeX of pointtree, crowns included: they are part of the one call. Our clouds carry no intensity."""
    for name in ("torch", "torch.utils", "torch.utils.data", "torch_scatter", "torch_cluster"):
        _stand_in(name)
    package = importlib.import_module("pointtree.instance_segmentation")
    presets = importlib.import_module("pointtree.instance_segmentation.tree_x_presets")
    own = dict(getattr(presets, settings)()) | {"stem_search_min_cluster_intensity": None}
    known = inspect.signature(package.TreeXAlgorithm.__init__).parameters
    algorithm = package.TreeXAlgorithm(**{key: value for key, value in own.items() if key in known})
    _, places, diameters = algorithm(np.ascontiguousarray(points, dtype=np.float64))
    return [[float(x), float(y), float(d) / 2] for (x, y), d in zip(places, diameters, strict=True)]


class _Absent(types.ModuleType):
    """Stands for a package that is imported for type annotations and metrics only; any use of it fails."""

    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


def _stand_in(name: str) -> None:
    """Stand in for torch, which pointtree imports (2 GB) for its metrics only; treeX does without."""
    module = _Absent(name)
    module.__spec__ = importlib.machinery.ModuleSpec(name, None)
    module.__path__ = []
    sys.modules[name] = module


PEERS = {"dendromatics": (dendromatics, tuple(DENDROMATICS)), "treex": (treex, TREEX)}


def main(name: str, cloud: str, out: str) -> None:
    """Run a peer with each of its settings; write what each found, its seconds and its fault, as far as it came."""
    points = np.load(cloud)["points_m"]
    find, all_settings = PEERS[name]
    runs: list[dict[str, object]] = []
    find_or_fault(find, points[:: max(1, len(points) // 20_000)], all_settings[0])  # the first call compiles and loads
    for settings in all_settings:
        begin = time.perf_counter()
        rows, fault = find_or_fault(find, points.copy(), settings)
        runs.append({"settings": settings, "stems": rows, "seconds": time.perf_counter() - begin, "fault": fault})
        Path(out).write_text(json.dumps(runs))


def find_or_fault(find: Callable[[Floats, str], Rows], points: Floats, settings: str) -> tuple[Rows, str]:
    """Return a peer's stems; or none and its fault: it may fail on a cloud in any way, and that is its result."""
    try:
        return find(points, settings), ""
    except Exception as error:  # noqa: BLE001
        return [], f"{type(error).__name__}: {error}"


if __name__ == "__main__":
    main(*sys.argv[1:4])
