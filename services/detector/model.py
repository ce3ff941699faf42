"""The detector's words: views, ground, slices, trunks, and why a candidate was none."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Views:
    """From where each point was seen.

    ``index`` (N,) names for each point the row of ``origins_m`` (V, 3), the camera centre in the points' frame.
    ``rotations`` (V, 3, 3), camera axes (optical) to the points' frame, and ``tan_half`` (horizontal, vertical),
    the tangents of half the field of view, tell what space was looked at; absent when unknown.
    """

    index: NDArray[np.int32]
    origins_m: Floats
    rotations: Floats | None = None
    tan_half: tuple[float, float] | None = None
    max_range_m: float = 6.0

    @classmethod
    def of_points(cls, origins_m: Floats) -> Views:
        """Return views from one origin per point, (N, 3); points of equal origin share a view."""
        origins, index = np.unique(np.asarray(origins_m, dtype=np.float64), axis=0, return_inverse=True)
        return cls(index.reshape(-1).astype(np.int32), np.ascontiguousarray(origins))


@dataclass(frozen=True, slots=True)
class Ground:
    """Ground as one plane per cell in the upright frame: ``z = a + b (x - xc) + c (y - yc)``, (xc, yc) the cell's centre."""

    x0_m: float
    y0_m: float
    cell_m: float
    planes: Floats = field(repr=False)
    """(nx, ny, 3): a, b, c."""
    seen: bool
    """False when no ground-like surface is in the cloud; heights are then above ``note``'s level."""
    note: str

    def height_m(self, x_m: float, y_m: float) -> float:
        """Return the ground's z at (x, y) of the upright frame."""
        nx, ny, _ = self.planes.shape
        i = min(max(int((x_m - self.x0_m) // self.cell_m), 0), nx - 1)
        j = min(max(int((y_m - self.y0_m) // self.cell_m), 0), ny - 1)
        a, b, c = self.planes[i, j]
        xc = self.x0_m + (i + 0.5) * self.cell_m
        yc = self.y0_m + (j + 0.5) * self.cell_m
        return float(a + b * (x_m - xc) + c * (y_m - yc))

    def heights_m(self, xy_m: Floats) -> Floats:
        """Return the ground's z at places (N, 2) of the upright frame."""
        nx, ny, _ = self.planes.shape
        low = np.array([self.x0_m, self.y0_m])
        cell = np.clip(((xy_m - low) // self.cell_m).astype(np.int64), 0, [nx - 1, ny - 1])
        plane = self.planes[cell[:, 0], cell[:, 1]]
        return np.asarray(plane[:, 0] + (plane[:, 1:] * (xy_m - low - (cell + 0.5) * self.cell_m)).sum(axis=1))


@dataclass(frozen=True, slots=True)
class Trunk:
    """One trunk in the frame of the input points."""

    base_m: tuple[float, float, float]
    """Where the axis meets the local ground."""
    axis: tuple[float, float, float]
    """Unit vector, upward."""
    radius_m: float
    radius_height_m: float
    """Height above ground at which ``radius_m`` holds."""
    taper: float
    """Change of radius per metre of height; negative when the trunk gets thinner upward."""
    height_seen_m: float
    """Height above ground of the highest part seen."""
    low_seen_m: float
    sigma_xy_m: float
    sigma_radius_m: float
    arc_rad: float
    confidence: float
    layers: int
    points: int
    noise_m: float
    """Scatter of the surface points, along the ray where views are known."""
    lean_rad: float
    suitable: bool
    remark: str
    """Why it is not suitable; empty otherwise."""
    range_m: float = 0.0
    """Mean distance that its points were seen from; 0 where that is unknown."""


@dataclass(frozen=True, slots=True)
class Rejection:
    """A candidate that was looked at and dropped."""

    x_m: float
    y_m: float
    z_m: float
    radius_m: float
    layers: int
    reason: str


@dataclass(frozen=True, slots=True)
class DetectionResult:
    """Trunks, sorted by distance from the cloud's origin of coordinates in the plan, and what was dropped."""

    trunks: tuple[Trunk, ...]
    rejections: tuple[Rejection, ...]
    ground: Ground
    up: tuple[float, float, float]
    points: int
    refused_points: int
    """Points that were NaN or infinite."""
    stages_ms: dict[str, float] = field(default_factory=dict)

    @property
    def trees(self) -> list[Trunk]:
        """Return the trunks as a list."""
        return list(self.trunks)
