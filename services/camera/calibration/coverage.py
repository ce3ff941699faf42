"""Do the pictures together show enough of the lens? What is missing, as a hint to the person who holds the board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.camera.calibration.board import Board, Sighting
from services.camera.calibration.solve import board_pose

Floats = NDArray[np.float64]

CELLS = (6, 5)
"""Columns and rows of cells into which a picture is cut."""
_REGIONS = (("upper left", "upper middle", "upper right"), ("left", "middle", "right"),
            ("lower left", "lower middle", "lower right"))  # fmt: skip
_GUESSED_FOCAL = 0.9
"""In picture widths: 58 degrees wide; good enough to see whether a board is tilted."""


@dataclass(frozen=True, slots=True)
class Needs:
    """What a set of pictures must have."""

    views: int = 8
    covered: float = 0.5
    """Share of the picture's cells in which a corner was seen."""
    tilted: int = 3
    """Pictures turned left or right, and pictures tipped up or down, by at least ``tilt_rad``."""
    tilt_rad: float = 0.21


@dataclass(frozen=True, slots=True)
class Coverage:
    """What a set of pictures has."""

    views: int
    cells: NDArray[np.int64]
    """(rows, columns) of CELLS: corners seen in each."""
    turned: int
    """Pictures in which the board is turned left or right."""
    tipped: int
    """Pictures in which it is tipped up or down."""

    @property
    def covered(self) -> float:
        """Share of cells with a corner."""
        return float(np.mean(self.cells > 0))

    def hints(self, needs: Needs) -> list[str]:
        """Return what is still missing, the most important first; empty when all is there."""
        out = []
        if self.covered < needs.covered:
            out.append(f"hold the board at the {self._emptiest()} of the picture")
        if self.turned < needs.tilted:
            out.append(f"turn the board left or right by 20 to 40 degrees ({self.turned} of {needs.tilted})")
        if self.tipped < needs.tilted:
            out.append(f"tip the board up or down by 20 to 40 degrees ({self.tipped} of {needs.tilted})")
        if self.views < needs.views:
            out.append(f"{needs.views - self.views} more pictures")
        return out

    def _emptiest(self) -> str:
        """Return the third of the picture with the fewest cells seen, in words."""
        seen = (self.cells > 0).astype(np.float64)
        shares = [[float(part.mean()) for part in np.array_split(row, 3, axis=1)] for row in np.array_split(seen, 3)]
        row, column = np.unravel_index(int(np.argmin(shares)), (3, 3))
        return _REGIONS[int(row)][int(column)]


def coverage(
    sightings: Sequence[Sighting], board: Board, size_px: tuple[int, int], needs: Needs, K: Floats | None = None,
    distortion: Floats | None = None,
) -> Coverage:  # fmt: skip
    """Return what the sightings have; without a camera (``K``) tilts are judged with a usual one."""
    cells = np.zeros((CELLS[1], CELLS[0]), np.int64)
    turned = tipped = 0
    camera = guessed_camera(size_px) if K is None else K
    lens = np.zeros(5) if distortion is None else distortion
    for sighting in sightings:
        column = np.clip((sighting.points_px[:, 0] / size_px[0] * CELLS[0]).astype(int), 0, CELLS[0] - 1)
        row = np.clip((sighting.points_px[:, 1] / size_px[1] * CELLS[1]).astype(int), 0, CELLS[1] - 1)
        np.add.at(cells, (row, column), 1)
        turn, tip = tilts_rad(board_pose(sighting, board, camera, lens))
        turned += abs(turn) >= needs.tilt_rad
        tipped += abs(tip) >= needs.tilt_rad
    return Coverage(len(sightings), cells, turned, tipped)


def tilts_rad(T_camera_board: Floats | None) -> tuple[float, float]:
    """Return how far a board is turned (left, right) and tipped (up, down) from square to the optical axis."""
    if T_camera_board is None:
        return 0.0, 0.0
    normal = T_camera_board[:3, 2] * np.sign(T_camera_board[2, 2])
    return float(np.arctan2(normal[0], normal[2])), float(np.arctan2(normal[1], normal[2]))


def guessed_camera(size_px: tuple[int, int]) -> Floats:
    """Return the matrix of a usual camera."""
    focal = _GUESSED_FOCAL * size_px[0]
    return np.array([[focal, 0.0, size_px[0] / 2.0], [0.0, focal, size_px[1] / 2.0], [0.0, 0.0, 1.0]])


class Collector:
    """Takes pictures from a live camera: those that add something, and says what to do next."""

    def __init__(self, board: Board, size_px: tuple[int, int], needs: Needs, most: int) -> None:
        self.sightings: list[Sighting] = []
        self._board, self._size_px, self._needs, self._most = board, size_px, needs, most

    def offer(self, sighting: Sighting) -> bool:
        """Keep a sighting unless one much like it is kept already."""
        if len(self.sightings) >= self._most or any(self._alike(sighting, other) for other in self.sightings):
            return False
        self.sightings.append(sighting)
        return True

    def hints(self) -> list[str]:
        """Return what is missing."""
        return coverage(self.sightings, self._board, self._size_px, self._needs).hints(self._needs)

    @property
    def done(self) -> bool:
        """Whether the pictures suffice, or no more are taken."""
        return len(self.sightings) >= self._most or not self.hints()

    def _alike(self, a: Sighting, b: Sighting) -> bool:
        """Return whether two sightings show the board in nearly the same place and attitude."""
        common, of_a, of_b = np.intersect1d(a.ids, b.ids, return_indices=True)
        if len(common) < 4:
            return False
        moved = np.linalg.norm(a.points_px[of_a] - b.points_px[of_b], axis=1)
        return float(np.sqrt(np.mean(moved**2))) < 0.05 * self._size_px[0]
