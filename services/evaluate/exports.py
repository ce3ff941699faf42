"""Results as files that other programs open: TUM trajectories, PLY clouds, trees as JSON, CSV and GeoJSON.

Every function returns the file's bytes; equal input gives equal bytes.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Target, Tree
from services.common.geometry import Matrix, quaternion_from_rotation

Stamped = tuple[int, Matrix]
"""A stamp in nanoseconds and T_map_camera (4, 4)."""

_DECIMALS = 6
"""Micrometres: far below any meaning, and short to read."""


def seconds_text(stamp_ns: int) -> str:
    """Return a stamp in seconds: as many decimals (6 or 9) as it needs, exactly."""
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    return f"{seconds}.{rest // 1000:06d}" if rest % 1000 == 0 else f"{seconds}.{rest:09d}"


def trajectory_bytes(poses: Iterable[Stamped]) -> bytes:
    """Return poses in TUM's format: ``stamp tx ty tz qx qy qz qw``, one line each, in the order given."""
    lines = ["# stamp tx ty tz qx qy qz qw: camera (optical) in map, metres"]
    for stamp_ns, T in poses:
        numbers = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        lines.append(" ".join([seconds_text(stamp_ns), *(f"{float(v) + 0.0:.7f}" for v in numbers)]))
    return ("\n".join(lines) + "\n").encode()


@dataclass(frozen=True, slots=True)
class Viewpoints:
    """From where each point of a cloud was seen: row of ``poses`` (K, 4, 4), T_map_camera, for each point (N,)."""

    index: NDArray[np.uint16]
    poses: Matrix


def ply_bytes(points_m: NDArray[np.float32], rgb: NDArray[np.uint8], seen: Viewpoints | None = None) -> bytes:
    """Return a binary PLY of points (N, 3) with colours (N, 3) RGB, or (0, 3) for none.

    With viewpoints each vertex names its own by number, and an element ``viewpoint`` holds position and orientation
    (quaternion x y z w) of the cameras: programs that do not know it pass over it, and ``treedock detect`` has the rays.
    """
    coloured = len(rgb) == len(points_m) and len(points_m) > 0
    fields: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if coloured:
        fields += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    if seen is not None:
        fields.append(("viewpoint", "<u2"))
    table = np.zeros(len(points_m), dtype=fields)
    for column, name in enumerate("xyz"):
        table[name] = points_m[:, column]
    if coloured:
        for column, name in enumerate(("red", "green", "blue")):
            table[name] = rgb[:, column]
    names = {"<f4": "float", "u1": "uchar", "<u2": "ushort"}
    header = ["ply", "format binary_little_endian 1.0", "comment treedock: map frame, metres, z up"]
    header += [f"element vertex {len(points_m)}", *(f"property {names[kind]} {name}" for name, kind in fields)]
    tail = b""
    if seen is not None:
        table["viewpoint"] = seen.index
        header.append(f"element viewpoint {len(seen.poses)}")
        header += [f"property float {name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw")]
        tail = b"".join(
            np.array([*T[:3, 3], *quaternion_from_rotation(T[:3, :3])], dtype="<f4").tobytes() for T in seen.poses
        )
    return ("\n".join([*header, "end_header"]) + "\n").encode() + table.tobytes() + tail


def tree_rows(trees: Sequence[Tree]) -> list[dict[str, Any]]:
    """Return trees as plain values, rounded to micrometres, in the order of their ids."""
    return [_rounded(tree.model_dump(mode="json")) for tree in sorted(trees, key=lambda tree: tree.id)]


def _rounded(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    if isinstance(value, float):
        return round(value, _DECIMALS) + 0.0
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    return [_rounded(item) for item in value] if isinstance(value, list | tuple) else value


def trees_json(trees: Sequence[Tree], frame: Literal["map", "input"]) -> bytes:
    """Return the contract's trees.json (design: the command line)."""
    return (json.dumps({"frame": frame, "trees": tree_rows(trees)}, indent=1, allow_nan=False) + "\n").encode()


def trees_csv(trees: Sequence[Tree]) -> bytes:
    """Return one line per tree; the axis becomes three columns."""
    names = [name for field in Tree.model_fields for name in _columns(field)]
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    for row in tree_rows(trees):
        flat = {name: value for key, item in row.items() for name, value in _flat(key, item)}
        writer.writerow([str(flat[n]).lower() if isinstance(flat[n], bool) else flat[n] for n in names])
    return out.getvalue().encode()


def _columns(field: str) -> list[str]:
    return ["axis_x", "axis_y", "axis_z"] if field == "axis" else [field]


def _flat(key: str, value: Any) -> list[tuple[str, Any]]:  # noqa: ANN401 - any JSON value
    return list(zip(_columns(key), value, strict=True)) if key == "axis" else [(key, value)]


def trees_geojson(trees: Sequence[Tree], frame: Literal["map", "input"]) -> bytes:
    """Return a point per tree, in metres of the map: there is no GPS, so no geographic reference.

    QGIS opens it once a local metric CRS is chosen for the layer.
    """
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [row["x_m"], row["y_m"], row["z_m"]]},
            "properties": {key: value for key, value in row.items() if key not in {"x_m", "y_m", "z_m"}},
        }
        for row in tree_rows(trees)
    ]
    body = {
        "type": "FeatureCollection",
        "treedock": {"frame": frame, "units": "m", "note": "local metres, x forward, y left, z up; not longitude and latitude"},
        "features": features,
    }  # fmt: skip
    return (json.dumps(body, indent=1, allow_nan=False) + "\n").encode()


def targets_jsonl(targets: Iterable[Target]) -> bytes:
    """Return one JSON object per frame: what the refinement said."""
    return b"".join((json.dumps(_rounded(target.model_dump(mode="json"))) + "\n").encode() for target in targets)
