"""Results for a GIS and for point-cloud programs: trees as GeoPackage, the map as LAZ. Equal input gives equal bytes."""

from __future__ import annotations

import datetime as dt
import io
import math
import sqlite3
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.inventory.geopackage import APPLICATION_ID, CORE_SQL, REQUIRED_SRS, USER_VERSION, point_blob

_LOCAL_SRS = -1
"""GeoPackage's undefined Cartesian system: metres of the map, not placed on the globe."""
_COLUMNS = (
    "tree_id INTEGER, diameter_cm DOUBLE, radius_m DOUBLE, radius_height_m DOUBLE, height_seen_m DOUBLE, lean_deg DOUBLE, "
    "sigma_xy_m DOUBLE, sigma_radius_m DOUBLE, arc_deg DOUBLE, confidence DOUBLE, observations INTEGER, suitable BOOLEAN, "
    "x_m DOUBLE, y_m DOUBLE, z_m DOUBLE"
)
_ABOUT = "trees of one recording: local metres, x along the first heading, y to its left; not on the globe"
_LAS_SCALE_M = 0.0001


def trees_gpkg(trees: Sequence[Tree], stamp_ns: int) -> bytes:
    """Return a GeoPackage with one point layer ``trees`` in local metres.

    Args:
        trees: in map.
        stamp_ns: of the results; it stands as the time of the last change.
    """
    db = sqlite3.connect(":memory:", isolation_level=None)
    try:
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        db.execute(f"PRAGMA user_version = {USER_VERSION}")
        db.executescript(CORE_SQL)
        db.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", REQUIRED_SRS)
        db.execute(f"CREATE TABLE trees (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom POINT, {_COLUMNS})")
        box = [float(f([getattr(t, k) for t in trees] or [0.0])) for f in (min, max) for k in ("x_m", "y_m")]
        changed = _utc(stamp_ns).strftime("%Y-%m-%dT%H:%M:%S.000Z")
        db.execute(
            "INSERT INTO gpkg_contents VALUES ('trees', 'features', 'trees', ?, ?, ?, ?, ?, ?, ?)",
            (_ABOUT, changed, *box, _LOCAL_SRS),
        )
        db.execute("INSERT INTO gpkg_geometry_columns VALUES ('trees', 'geom', 'POINT', ?, 0, 0)", (_LOCAL_SRS,))
        rows = [_row(tree) for tree in sorted(trees, key=lambda tree: tree.id)]
        marks = ",".join("?" * (2 + _COLUMNS.count(",") + 1))
        db.executemany(f"INSERT INTO trees VALUES ({marks})", rows)
        return bytes(db.serialize())
    finally:
        db.close()


def _row(tree: Tree) -> tuple[object, ...]:
    lean_deg = math.degrees(math.acos(min(1.0, max(-1.0, tree.axis[2]))))
    return (
        None, point_blob(tree.x_m, tree.y_m, _LOCAL_SRS), tree.id, 200.0 * tree.radius_m, tree.radius_m,
        tree.radius_height_m, tree.height_seen_m, lean_deg, tree.sigma_xy_m, tree.sigma_radius_m,
        math.degrees(tree.arc_rad), tree.confidence, tree.observations, tree.suitable, tree.x_m, tree.y_m, tree.z_m,
    )  # fmt: skip


def cloud_laz(points_m: NDArray[np.float32], rgb: NDArray[np.uint8], stamp_ns: int) -> bytes:
    """Return the map as LAZ 1.4, point format 7, in local metres to a tenth of a millimetre.

    Args:
        points_m: (N, 3) in map.
        rgb: (N, 3), or (0, 3) for none.
        stamp_ns: of the results; its day stands as the file's.
    """
    return laz_bytes(points_m, rgb, stamp_ns)


def laz_bytes(
    points_m: NDArray[np.float32], rgb: NDArray[np.uint8], stamp_ns: int, classes: NDArray[np.uint8] | None = None,
    more: Mapping[str, NDArray[Any]] | None = None,
) -> bytes:  # fmt: skip
    """Return the same with LAS classes (N,) and further values per point, by name."""
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, _LAS_SCALE_M)
    header.offsets = np.zeros(3)
    header.creation_date = _utc(stamp_ns).date()
    header.generating_software = "treedock"
    for name, values in (more or {}).items():
        header.add_extra_dim(laspy.ExtraBytesParams(name=name, type=values.dtype))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points_m[:, k].astype(np.float64) for k in range(3))
    if len(rgb) == len(points_m) and len(rgb):
        # LAS colours have 16 bits; programs expect the upper ones filled
        las.red, las.green, las.blue = (rgb[:, k].astype(np.uint16) * 257 for k in range(3))
    if classes is not None:
        las.classification = classes
    for name, values in (more or {}).items():
        las[name] = values
    out = io.BytesIO()
    las.write(out, do_compress=True)
    return out.getvalue()


def _utc(stamp_ns: int) -> dt.datetime:
    return dt.datetime.fromtimestamp(stamp_ns // 1_000_000_000, dt.UTC)
