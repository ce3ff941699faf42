"""Runs one peer on one cloud, in the peers' own environment: ``python peer_driver.py NAME CLOUD.npz OUT.json``.

Stands alone: nothing of treedock is imported, since none of it is installed there. The cloud (N, 3) has z up.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import json
import sys
import time
import types
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = list[list[float]]
"""x, y, radius of each stem."""


_VERTICALITY: tuple[dict[str, float], ...] = (
    {},
    {"n_points": 100, "resolution_xy": 0.04, "resolution_z": 0.04},
    {"scale": 0.25, "vert_threshold": 0.6, "n_points": 300},
    {"scale": 0.25, "vert_threshold": 0.6, "n_points": 60, "resolution_xy": 0.05, "resolution_z": 0.05},
)
"""Settings of dendromatics' test of verticality: the defaults; fewer and wider apart, for thinned clouds; wider and laxer, which
the noise of a camera's cloud needs. The first with which it finds anything counts."""


def dendromatics(points: Floats) -> Rows:
    """Find stems as the package's documentation chains its functions."""
    for settings in _VERTICALITY:
        try:
            rows = _dendromatics(points, **settings)
        except (ValueError, IndexError):  # its way of saying that no cluster was a stem
            continue
        if rows:
            return rows
    return []


def _dendromatics(points: Floats, **verticality: float) -> Rows:
    dm = importlib.import_module("dendromatics")
    cloth = dm.clean_cloth(dm.generate_dtm(dm.clean_ground(points)))
    heights = dm.normalize_heights(points, cloth)
    cloud = np.column_stack([points, heights])
    stripe = cloud[(heights > 0.7) & (heights < 3.5)]
    clustered = dm.verticality_clustering(stripe, **verticality)
    trees, vectors = dm.individualize_trees(cloud, clustered)[:2]
    sections = np.arange(0.3, 3.0, 0.2)
    x, y, radius, _, occupied = dm.compute_sections(trees, sections)[:5]
    outliers = dm.tilt_detection(x, y, radius, sections)
    diameters, places = dm.tree_locator(sections, x, y, vectors, occupied, radius, outliers)
    rows = []
    for place, diameter, found in zip(places, np.ravel(diameters), radius, strict=True):
        good = found[found > 0]
        r = diameter / 2 if diameter > 0 else (float(np.median(good)) if len(good) else 0.0)
        rows.append([float(place[0]), float(place[1]), float(r)])
    return rows


def treex(points: Floats) -> Rows:
    """Find stems with treeX of pointtree, default preset, crowns included: they are part of the one call."""
    for name in ("torch", "torch.utils", "torch.utils.data", "torch_scatter", "torch_cluster"):
        _stand_in(name)
    algorithm = importlib.import_module("pointtree.instance_segmentation").TreeXAlgorithm()
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


PEERS = {"dendromatics": dendromatics, "treex": treex}


def main(name: str, cloud: str, out: str) -> None:
    """Run a peer twice (the first call compiles and loads) and write its stems and the seconds of both."""
    points = np.load(cloud)["points_m"]
    spent, rows, fault = [], [], ""
    for _ in range(2):
        begin = time.perf_counter()
        try:
            rows = PEERS[name](points.copy())
        except Exception as error:  # noqa: BLE001 - a peer may fail on a cloud in any way: that is its result
            fault = f"{type(error).__name__}: {error}"
            rows = []
        spent.append(time.perf_counter() - begin)
        if fault or spent[0] > 60.0:
            break
    Path(out).write_text(json.dumps({"stems": rows, "seconds": spent, "fault": fault}))


if __name__ == "__main__":
    main(*sys.argv[1:4])
