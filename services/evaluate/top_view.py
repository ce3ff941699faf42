"""The map from above as inline SVG: points, path and trees, with a metre grid and a legend."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Tree
from services.evaluate.exports import Stamped

_MARGIN_M = 1.0
_WIDTH_PX = 720.0
_MAX_HEIGHT_PX = 560.0
_CELLS = 480
"""Cells of the point raster along the page."""
_LEGEND_PX = 26.0
_PATH, _SUITABLE, _OTHER = "#2563eb", "#15803d", "#a16207"


@dataclass(frozen=True, slots=True)
class _Frame:
    """The part of the map shown: x (first heading) up the page, y (left) to the left."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]

    @classmethod
    def around(cls, places_m: NDArray[np.float64]) -> _Frame:
        low, high = places_m.min(axis=0) - _MARGIN_M, places_m.max(axis=0) + _MARGIN_M
        wide_m = (high[0] - low[0]) * _WIDTH_PX / _MAX_HEIGHT_PX
        spare_m = max(0.0, wide_m - (high[1] - low[1])) / 2.0
        return cls((float(low[0]), float(high[0])), (float(low[1] - spare_m), float(high[1] + spare_m)))

    @property
    def scale(self) -> float:
        return _WIDTH_PX / (self.y_m[1] - self.y_m[0])

    @property
    def height_px(self) -> float:
        return self.scale * (self.x_m[1] - self.x_m[0])

    def place(self, x_m: float, y_m: float) -> tuple[str, str]:
        return f"{self.scale * (self.y_m[1] - y_m):.1f}", f"{self.scale * (self.x_m[1] - x_m):.1f}"


def top_view_svg(
    trees: Sequence[Tree], trajectory: Sequence[Stamped], points_m: NDArray[np.float32] | None = None
) -> str:
    """Return the SVG; ``points_m`` (N, 3) in map become a grey raster in which upright things are dark."""
    path = np.array([T[:2, 3] for _, T in trajectory], dtype=float).reshape(-1, 2)
    stems = np.array([(t.x_m, t.y_m) for t in trees], dtype=float).reshape(-1, 2)
    frame = _Frame.around(np.vstack([path, stems, np.zeros((1, 2))]))
    size = f"0 0 {_WIDTH_PX:.0f} {frame.height_px + _LEGEND_PX:.0f}"
    parts = [f'<svg viewBox="{size}" role="img" aria-label="map from above" font-size="12">']
    parts += _raster(frame, points_m) + _grid(frame) + _path(frame, path)
    for tree in sorted(trees, key=lambda tree: tree.id):
        x, y = frame.place(tree.x_m, tree.y_m)
        colour = _SUITABLE if tree.suitable else _OTHER
        radius_px = max(frame.scale * tree.radius_m, 3.0)
        parts.append(f'<circle cx="{x}" cy="{y}" r="{radius_px:.1f}" fill="{colour}"/>')
        parts.append(f'<text x="{x}" y="{y}" dx="{radius_px + 3:.0f}" dy="-5" font-weight="600">{tree.id}</text>')
    return "\n".join([*parts, *_legend(frame), "</svg>"])


def _grid(frame: _Frame) -> list[str]:
    """Return a line per metre (or more, where they would stand too close), each with its coordinate."""
    step = next(step for step in (1, 2, 5, 10, 20, 50, 100, 10**6) if step * frame.scale >= 32.0)
    parts = []
    for metre in range(step * int(np.ceil(frame.x_m[0] / step)), int(np.floor(frame.x_m[1])) + 1, step):
        y = frame.place(metre, 0.0)[1]
        parts.append(f'<line x1="0" x2="{_WIDTH_PX:.0f}" y1="{y}" y2="{y}" stroke="#1d2a20" stroke-opacity="0.12"/>')
        parts.append(f'<text x="3" y="{y}" dy="-3" fill="#5c6b60">x {metre} m</text>')
    for metre in range(step * int(np.ceil(frame.y_m[0] / step)), int(np.floor(frame.y_m[1])) + 1, step):
        x = frame.place(0.0, metre)[0]
        end = f"{frame.height_px:.0f}"
        parts.append(f'<line y1="0" y2="{end}" x1="{x}" x2="{x}" stroke="#1d2a20" stroke-opacity="0.12"/>')
        parts.append(f'<text x="{x}" y="{end}" dx="3" dy="-4" fill="#5c6b60">y {metre}</text>')
    return parts


def _path(frame: _Frame, path: NDArray[np.float64]) -> list[str]:
    if not len(path):
        return []
    line = " ".join(",".join(frame.place(float(x), float(y))) for x, y in path)
    (x0, y0), (x1, y1) = (frame.place(float(p[0]), float(p[1])) for p in (path[0], path[-1]))
    return [
        f'<polyline points="{line}" fill="none" stroke="{_PATH}" stroke-width="2" stroke-linejoin="round"/>',
        f'<rect x="{x0}" y="{y0}" width="9" height="9" transform="translate(-4.5 -4.5)" fill="#fff" stroke="{_PATH}" stroke-width="2"/>',
        f'<rect x="{x1}" y="{y1}" width="9" height="9" transform="translate(-4.5 -4.5)" fill="{_PATH}"/>',
    ]


def _legend(frame: _Frame) -> list[str]:
    y = frame.height_px + _LEGEND_PX / 2.0
    entries = (("#fff", _PATH, "start"), (_PATH, _PATH, "end of the camera's path"), (_SUITABLE, _SUITABLE, "suitable tree"),
               (_OTHER, _OTHER, "other tree"), ("#9aa69d", "#9aa69d", "points of the map"))  # fmt: skip
    parts = [f'<rect x="0" y="{frame.height_px:.1f}" width="100%" height="{_LEGEND_PX:.0f}" fill="#fff"/>']
    x = 10.0
    for fill, stroke, word in entries:
        shape = (
            f'rect x="{x - 4.5}" y="{y - 4.5}" width="9" height="9"'
            if stroke == _PATH
            else f'circle cx="{x}" cy="{y}" r="5"'
        )
        parts.append(f'<{shape} fill="{fill}" stroke="{stroke}" stroke-width="2"/>')
        parts.append(f'<text x="{x + 11:.0f}" y="{y:.1f}" dy="4">{word}</text>')
        x += 34.0 + 6.6 * len(word)
    return parts


def _raster(frame: _Frame, points_m: NDArray[np.float32] | None) -> list[str]:
    """Return the points as an embedded image: the more in a cell, the darker."""
    if points_m is None or not len(points_m):
        return []
    rows = max(1, round(_CELLS * frame.height_px / _WIDTH_PX))
    counts, _, _ = np.histogram2d(points_m[:, 0], points_m[:, 1], bins=(rows, _CELLS), range=(frame.x_m, frame.y_m))
    shade = np.log1p(counts[::-1, ::-1])
    alpha = np.where(shade > 0, 40.0 + 190.0 * shade / max(float(shade.max()), 1e-9), 0.0).astype(np.uint8)
    data = base64.b64encode(_png(alpha)).decode()
    return [
        f'<image x="0" y="0" width="{_WIDTH_PX:.0f}" height="{frame.height_px:.1f}" preserveAspectRatio="none" '
        f'href="data:image/png;base64,{data}"/>'
    ]


def _png(alpha: NDArray[np.uint8]) -> bytes:
    """Return (H, W) opacities of one dark grey as a grey-and-alpha PNG."""
    height, width = alpha.shape
    pixels = np.stack([np.full_like(alpha, 60), alpha], axis=2).reshape(height, 2 * width)
    lines = np.hstack([np.zeros((height, 1), np.uint8), pixels]).tobytes()

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, 8, 4, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines, 9)) + chunk(b"IEND", b"")
