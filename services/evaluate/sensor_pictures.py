"""One picture that sets the sensors side by side: what each measures, and the nearest trunk in its map."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.simulation import TrueTree
from services.detector.model import Trunk
from services.evaluate.detection_clouds import SceneCloud
from services.evaluate.sensor_clouds import RIGS, Rig, depth_view, sensor_cloud

Picture = NDArray[np.uint8]

_SIDE_PX = 220
_HALF_M = 0.35
_SLICE_M = 0.15
_TALL_M = 3.0
_FARTHEST_M = 6.0
_LOOKS_BACK = 6
"""Keyframes before the last one: a metre and a half from the tree."""
_INK, _FIT, _TRUE = (60, 50, 40), (40, 40, 210), (60, 150, 60)


def comparison(scene: str, cache: Path, path: Path) -> None:
    """Write the picture for a scene: a row for each sensor with depth image, trunk from above, trunk from the side."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [_row(scene, rig, sensor_cloud(scene, rig, cache)) for rig in RIGS]
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_WEBP_QUALITY, 70])


def _row(scene: str, rig: Rig, cloud: SceneCloud) -> Picture:
    from services.detector.detect import detect_trees

    tree = _nearest(cloud)
    found = detect_trees(cloud.points_m, (0.0, 0.0, 1.0), cloud.views, rig.detector()).trunks
    own = next((t for t in found if np.hypot(t.base_m[0] - tree.x_m, t.base_m[1] - tree.y_m) < 0.3), None)
    depth = _depth_picture(depth_view(scene, rig, -_LOOKS_BACK))
    cv2.putText(
        depth, f"{rig.name}: {rig.technology}", (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA
    )
    return np.hstack([depth, _from_above(cloud, tree, own), _from_the_side(cloud, tree)])


def _nearest(cloud: SceneCloud) -> TrueTree:
    """Return the tree that the flight ends at: the suitable one nearest to the last keyframe."""
    last = cloud.views.origins_m[-1]
    return min((t for t in cloud.trees if t.suitable), key=lambda t: np.hypot(t.x_m - last[0], t.y_m - last[1]))


def _depth_picture(depth_mm: NDArray[np.uint16]) -> Picture:
    """Return depth by colour, near red, far blue, none black, at the rows' height."""
    share = np.clip(depth_mm / (1000.0 * _FARTHEST_M), 0.0, 1.0)
    coloured = cv2.applyColorMap((255.0 * (1.0 - share)).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[depth_mm == 0] = 0
    width = round(depth_mm.shape[1] * _SIDE_PX / depth_mm.shape[0])
    small = cv2.resize(coloured, (width, _SIDE_PX), interpolation=cv2.INTER_AREA)
    out = np.zeros((_SIDE_PX, 390, 3), dtype=np.uint8)
    out[:, : min(width, 390)] = small[:, :390]
    return out


def _from_above(cloud: SceneCloud, tree: TrueTree, own: Trunk | None) -> Picture:
    out = np.full((_SIDE_PX, _SIDE_PX, 3), 250, dtype=np.uint8)
    centre = np.array([tree.x_m, tree.y_m, tree.z_m]) + 1.3 / tree.axis[2] * np.array(tree.axis)
    near = cloud.points_m[np.abs(cloud.points_m[:, 2] - centre[2]) < _SLICE_M, :2] - centre[:2]
    _dots(out, near / (2.0 * _HALF_M) + 0.5)
    scale = _SIDE_PX / (2.0 * _HALF_M)
    middle = _SIDE_PX // 2
    cv2.circle(out, (middle, middle), round(tree.radius_m * scale), _TRUE, 1, cv2.LINE_AA)
    if own is not None:
        at = np.array(own.base_m) + own.radius_height_m / own.axis[2] * np.array(own.axis) - centre
        place = (round(middle + scale * at[0]), round(middle - scale * at[1]))
        cv2.circle(out, place, round(own.radius_m * scale), _FIT, 1, cv2.LINE_AA)
    cv2.line(out, (8, _SIDE_PX - 8), (8 + round(0.1 * scale), _SIDE_PX - 8), _INK, 2)
    cv2.putText(out, "10 cm", (8, _SIDE_PX - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.4, _INK, 1, cv2.LINE_AA)
    return out


def _from_the_side(cloud: SceneCloud, tree: TrueTree) -> Picture:
    out = np.full((_SIDE_PX, _SIDE_PX, 3), 250, dtype=np.uint8)
    offset = cloud.points_m - np.array([tree.x_m, tree.y_m, tree.z_m], dtype=np.float32)
    slab = offset[np.abs(offset[:, 0]) < 0.6]
    _dots(out, np.column_stack([slab[:, 1] / _TALL_M + 0.5, (slab[:, 2] + 0.3) / _TALL_M]))
    return out


def _dots(picture: Picture, places: NDArray[np.floating]) -> None:
    """Darken the pixels at places (N, 2), shares of the side, up is up; many points make black."""
    u = np.floor(places[:, 0] * _SIDE_PX).astype(int)
    v = np.floor((1.0 - places[:, 1]) * _SIDE_PX).astype(int)
    inside = (u >= 0) & (u < _SIDE_PX) & (v >= 0) & (v < _SIDE_PX)
    hits = np.zeros((_SIDE_PX, _SIDE_PX), dtype=np.int64)
    np.add.at(hits, (v[inside], u[inside]), 1)
    picture[:] = np.maximum(picture.astype(np.int64) - 60 * np.minimum(hits, 4)[..., None], 0).astype(np.uint8)
