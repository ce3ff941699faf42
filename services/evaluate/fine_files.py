"""The finer map's files: cloud with tree ids as LAZ, stems as JSON and CSV, ground as a grid. Equal input, equal bytes."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from services.evaluate.fine import FineResult
from services.evaluate.gis_exports import laz_bytes
from services.fine.model import Section, Stem
from services.fine.segment import Segments

_GROUND_CLASS, _TREE_CLASS, _OTHER_CLASS = 2, 5, 1
"""LAS 1.4: ground, high vegetation, unclassified."""
_DECIMALS = 5
_NODATA = -9999.0
_MOST_CELLS = 4_000_000


def fine_files(result: FineResult, stamp_ns: int) -> dict[str, bytes]:
    """Return the files by name; ``stamp_ns`` of the results gives the LAZ its day."""
    files = {
        "fine_cloud.laz": fine_laz(result, stamp_ns),
        "trees_fine.json": trees_fine_json(result),
        "trees_fine.csv": _csv(_TREE_COLUMNS, (_tree_row(stem) for stem in result.stems)),
        "sections_fine.csv": _csv(_SECTION_COLUMNS, (_section_row(stem, s) for stem in result.stems for s in stem.sections)),
    }  # fmt: skip
    grid = ground_grid(result.segments)
    if grid is not None:
        files["ground_fine.asc"] = grid
    return files


def fine_laz(result: FineResult, stamp_ns: int) -> bytes:
    """Return the cloud as LAZ 1.4 with colours, classes and, per point, ``tree_id`` (0: none) and ``height_m`` above ground.

    ``tree_id`` is the tree's id plus one, because ids begin at 0.
    """
    segments = result.segments
    classes = np.full(len(segments.ground), _OTHER_CLASS, dtype=np.uint8)
    classes[segments.ground] = _GROUND_CLASS
    classes[segments.tree_id > 0] = _TREE_CLASS
    more = {"tree_id": segments.tree_id.astype(np.uint32), "height_m": segments.height_m.astype(np.float32)}
    return laz_bytes(result.cloud.points_m, result.cloud.rgb, stamp_ns, classes, more)


def trees_fine_json(result: FineResult) -> bytes:
    """Return the stems with their sections and taper functions."""
    body = {
        "frame": "map",
        "taper": "diameter_m(h) = diameter_13_m + taper_m_per_m (h - diameter_height_m), h metres above ground, within the sections used",
        "trees": [_tree_json(stem) for stem in result.stems],
        "not_measured": sorted(result.unmeasured),
    }  # fmt: skip
    return (json.dumps(body, indent=1, allow_nan=False) + "\n").encode()


def _tree_json(stem: Stem) -> dict[str, Any]:
    row = dict(zip(_TREE_COLUMNS, _tree_row(stem), strict=True))
    row["sections"] = [dict(zip(_SECTION_COLUMNS[1:], _section_row(stem, s)[1:], strict=True)) for s in stem.sections]
    return row


_TREE_COLUMNS = (
    "id", "x_m", "y_m", "z_m", "axis_x", "axis_y", "axis_z", "diameter_13_m", "sigma_13_m", "diameter_height_m", "taper_m_per_m",
    "sigma_taper", "sections_used", "frames", "points", "suitable",
)  # fmt: skip
_SECTION_COLUMNS = ("id", "height_m", "diameter_m", "sigma_m", "arc_rad", "points", "used")


def _tree_row(stem: Stem) -> list[Any]:
    numbers = (
        *stem.base_m,
        *stem.axis,
        stem.diameter_13_m,
        stem.sigma_13_m,
        stem.height_m,
        stem.taper_m_per_m,
        stem.sigma_taper,
    )
    used = sum(section.used for section in stem.sections)
    return [stem.tree_id, *(_rounded(v) for v in numbers), used, stem.frames, stem.points, stem.suitable]


def _section_row(stem: Stem, s: Section) -> list[Any]:
    numbers = (_rounded(v) for v in (s.height_m, s.diameter_m, s.sigma_m, s.arc_rad))
    return [stem.tree_id, *numbers, s.points, s.used]


def _rounded(value: float) -> float:
    return round(float(value), _DECIMALS) + 0.0


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([str(v).lower() if isinstance(v, bool) else v for v in row])
    return out.getvalue().encode()


def ground_grid(segments: Segments) -> bytes | None:
    """Return the ground as an Esri ASCII grid (QGIS opens it), map metres; None where no ground shows.

    Cells without a ground point of their own hold no data.
    """
    model = segments.model
    if model is None or model.planes.shape[0] * model.planes.shape[1] > _MOST_CELLS:
        return None
    heights = model.planes[..., 0] + segments.shift_m[2]
    seen = segments.ground_cells
    rows = np.where(seen, heights, _NODATA).T[::-1]
    x0, y0 = model.x0_m + segments.shift_m[0], model.y0_m + segments.shift_m[1]
    head = [
        f"ncols {model.planes.shape[0]}", f"nrows {model.planes.shape[1]}", f"xllcorner {x0:.3f}", f"yllcorner {y0:.3f}",
        f"cellsize {model.cell_m:g}", f"NODATA_value {_NODATA:g}",
    ]  # fmt: skip
    lines = [" ".join(f"{v:g}" if v == _NODATA else f"{v:.3f}" for v in row) for row in rows]
    return ("\n".join([*head, *lines]) + "\n").encode()
