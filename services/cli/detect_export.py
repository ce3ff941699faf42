"""Each tree with its own points and the ground around it, as one LAZ file per tree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.common.errors import InputError
from services.detector.model import DetectionResult, Floats, Trunk
from services.detector.upright import Upright, upright_frame

GROUND_WITHIN_M = 1.5
_GROUND_BAND_M = 0.20
_GROUND_CLASS, _TREE_CLASS = 2, 5
_SCALE_M = 0.0001


def export_trees(folder: Path, points_m: NDArray[np.floating], result: DetectionResult) -> list[Path]:
    """Write ``tree-001.laz`` and so on: the tree as class 5, the ground within 1.5 m of it as class 2; return the files.

    Raises:
        InputError: the folder cannot be written.
    """
    frame = upright_frame(points_m, result.up)
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, trunk in enumerate(result.trunks, start=1):
            chosen, classes = tree_points(frame, result, trunk)
            paths.append(folder / f"tree-{number:03d}.laz")
            _write(paths[-1], np.asarray(points_m[chosen], dtype=np.float64), classes)
    except OSError as error:
        raise InputError(f"--export-trees {folder}: cannot be written: {error.strerror}") from error
    return paths


def tree_points(frame: Upright, result: DetectionResult, trunk: Trunk) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return the rows of a tree's points and of the ground around it, and their LAS classes.

    A point is the tree's when it lies within its radius and 10 cm of the axis, up to where the trunk was seen and a metre
    more. It is ground within 20 cm of the surface.
    """
    base = frame.from_input(np.array(trunk.base_m))
    axis = frame.R @ np.array(trunk.axis)
    xyz = frame.xyz_m
    flat = np.hypot(xyz[:, 0] - base[0], xyz[:, 1] - base[1])
    reach = GROUND_WITHIN_M + abs(float(np.tan(trunk.lean_rad))) * (trunk.height_seen_m + 1.0)
    near = np.flatnonzero(flat < reach)
    p = xyz[near].astype(np.float64)
    height = p[:, 2] - result.ground.heights_m(p[:, :2])
    along = (p[:, 2] - base[2]) / axis[2]
    from_axis = np.linalg.norm(p[:, :2] - base[:2] - along[:, None] * axis[:2], axis=1)
    surface = trunk.radius_m + trunk.taper * (height - trunk.radius_height_m) + 0.10
    tree = (from_axis < surface) & (height > 0.05) & (height < trunk.height_seen_m + 1.0)
    ground = ~tree & (np.abs(height) < _GROUND_BAND_M) & (flat[near] < GROUND_WITHIN_M)
    kept = tree | ground
    return near[kept], np.where(tree[kept], _TREE_CLASS, _GROUND_CLASS).astype(np.uint8)


def _write(path: Path, points_m: Floats, classes: NDArray[np.uint8]) -> None:
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.floor(points_m.min(axis=0)) if len(points_m) else np.zeros(3)
    header.generating_software = "treedock"
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points_m[:, k] for k in range(3))
    las.classification = classes
    with path.open("wb") as stream:
        las.write(stream, do_compress=True)
