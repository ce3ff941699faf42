"""A picture of each listed stem of a cloud, to be looked at by eye: ``python -m services.evaluate.contact_sheet CLOUD OUT``.

Left the cross-section at breast height (black: 0.3 m of it, grey: 1 m) with the fitted circle, right the side view with
the fitted axis' outline, 1.8 m wide, from 0.3 m below the ground to 4 m above it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from services.common.geometry import rotation_aligning
from services.detector.detect import detect_trees
from services.detector.model import Trunk
from services.detector.readers import read_cloud
from services.detector.vertical import find_vertical

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

_RED, _BLUE, _BLACK, _GREY, _LIGHT = (0, 0, 255), (200, 0, 0), (0, 0, 0), (90, 90, 90), (205, 205, 205)
_TOP_M, _BELOW_M, _SIDE_M = 4.0, 0.3, 1.8


def contact_sheet(points_m: Floats, trunks: tuple[Trunk, ...], size: int = 150, columns: int = 5) -> Picture:
    """Return all stems of a cloud with z up as one picture; each cell is ``size`` high and twice as wide."""
    cells = [_cell(points_m, trunk, number, size) for number, trunk in enumerate(trunks, start=1)]
    while len(cells) % columns:
        cells.append(np.full((size, 2 * size, 3), 255, dtype=np.uint8))
    return np.vstack([np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)])


def _cell(points_m: Floats, trunk: Trunk, number: int, size: int) -> Picture:
    base, axis = np.array(trunk.base_m), np.array(trunk.axis)
    near = points_m[np.abs(points_m[:, :2] - base[:2]).max(axis=1) < 2.5] - base
    along = near @ axis
    picture = np.full((size, 2 * size, 3), 255, dtype=np.uint8)
    half = max(0.35, 2.2 * trunk.radius_m)
    across = (near - along[:, None] * axis)[:, :2]
    height = np.abs(along - trunk.radius_height_m)
    for reach, colour in ((0.5, _LIGHT), (0.15, _BLACK)):
        _dots(picture[:, :size], (across[height < reach] / half + 1.0) / 2.0, colour)
    cv2.circle(picture, (size // 2, size // 2), round(trunk.radius_m / half * size / 2), _RED, 1, cv2.LINE_AA)
    slab = near[(np.abs(near[:, 1]) < half) & (np.abs(near[:, 0]) < _SIDE_M / 2)]
    side = np.stack([slab[:, 0] / _SIDE_M + 0.5, (slab[:, 2] + _BELOW_M) / (_TOP_M + _BELOW_M)], axis=1)
    _dots(picture[:, size:], side, _GREY)
    _outline(picture[:, size:], trunk, size)
    cv2.rectangle(picture, (0, 0), (2 * size - 1, size - 1), (170, 170, 170), 1)
    text = f"{number}: {200 * trunk.radius_m:.1f} cm{'' if trunk.suitable else ' (' + trunk.remark[:12] + ')'}"
    cv2.putText(picture, text, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _BLUE, 1, cv2.LINE_AA)
    return picture


def _dots(picture: Picture, places: Floats, colour: tuple[int, int, int]) -> None:
    """Paint places (N, 2), shares of the width and (from below) of the height."""
    height, width = picture.shape[:2]
    u, v = np.floor(places[:, 0] * width).astype(int), np.floor((1.0 - places[:, 1]) * height).astype(int)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    picture[v[inside], u[inside]] = colour


def _outline(picture: Picture, trunk: Trunk, size: int) -> None:
    lean = trunk.axis[0] / max(trunk.axis[2], 0.5)
    for side in (-1.0, 1.0):
        ends = []
        for z in (0.0, min(trunk.height_seen_m, _TOP_M)):
            x = (lean * z + side * trunk.radius_m) / _SIDE_M + 0.5
            ends.append((round(x * size), round((1.0 - (z + _BELOW_M) / (_TOP_M + _BELOW_M)) * size)))
        cv2.line(picture, ends[0], ends[1], _RED, 1, cv2.LINE_AA)


def main(cloud: str, out: str) -> None:
    """Detect the trees of a cloud and write the sheet."""
    points = read_cloud(Path(cloud)).points_m
    points = points @ rotation_aligning(find_vertical(points).up, (0.0, 0.0, 1.0)).T
    trunks = detect_trees(points, (0.0, 0.0, 1.0)).trunks
    cv2.imwrite(out, contact_sheet(points, trunks), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    for number, t in enumerate(trunks, start=1):
        sys.stdout.write(f"{number}: x {t.base_m[0]:.2f} y {t.base_m[1]:.2f} diameter {200 * t.radius_m:.1f} cm confidence {t.confidence:.2f} {t.remark}\n")  # fmt: skip


if __name__ == "__main__":
    main(*sys.argv[1:3])
