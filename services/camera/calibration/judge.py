"""Is it good enough? Pictures one by one, then the result, against limits that are told; with reasons and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from services.camera.calibration.board import Board, Grey, Sighting, edge_width_px, find_board
from services.camera.calibration.coverage import Coverage, Needs, coverage
from services.camera.calibration.solve import Solution, solve

_WIDTH_PX = 640.0
"""Limits in pixels are for pictures this wide, and grow with wider ones."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What passes."""

    needs: Needs = field(default_factory=Needs)
    edge_px: float = 4.0
    """Width of a board's edge in a sharp picture."""
    rms_px: float = 0.3
    focal_sigma: float = 0.0025
    """Standard deviation of the focal lengths, relative."""
    centre_share: float = 0.15
    """Largest distance of the principal point from the picture's middle, in picture widths."""

    def told(self, width_px: int) -> str:
        """Return the limits in one line."""
        s = scale(width_px)
        return (
            f"{self.needs.views} pictures or more, edges at most {s * self.edge_px:.1f} px wide, corners in "
            f"{self.needs.covered:.0%} of the picture, {self.needs.tilted} turned and {self.needs.tilted} tipped by "
            f"{np.degrees(self.needs.tilt_rad):.0f} degrees, reprojection at most {s * self.rms_px:.2f} px, focal length "
            f"known to {self.focal_sigma:.2%}"
        )


@dataclass(frozen=True, slots=True)
class Picture:
    """What became of one picture."""

    name: str
    fault: str
    """Why it is not used; empty for a good one."""
    sighting: Sighting | None = None


@dataclass(frozen=True, slots=True)
class Result:
    """A calibration with its verdict."""

    pictures: tuple[Picture, ...]
    solution: Solution | None
    coverage: Coverage
    faults: tuple[str, ...]
    """Why it fails, each with what to do; empty: it passes."""

    @property
    def passed(self) -> bool:
        """Whether the camera may be used."""
        return not self.faults and self.solution is not None


def scale(width_px: int) -> float:
    """Return by how much limits in pixels grow for pictures wider than 640."""
    return max(1.0, width_px / _WIDTH_PX)


def look(name: str, grey: Grey, board: Board, limits: Limits, *, thorough: bool = True) -> Picture:
    """Find the board in a picture and judge the picture's sharpness."""
    sighting = find_board(grey, board, thorough=thorough)
    if sighting is None:
        return Picture(name, "board not found")
    width = edge_width_px(grey, board, sighting)
    limit = scale(grey.shape[1]) * limits.edge_px
    if width > limit:
        return Picture(name, f"blurred: edges {width:.1f} px wide, at most {limit:.1f}")
    return Picture(name, "", sighting)


def calibrate(pictures: Sequence[Picture], board: Board, size_px: tuple[int, int], limits: Limits) -> Result:
    """Solve with the good pictures and judge the result."""
    good = [p.sighting for p in pictures if p.sighting is not None]
    solution = solve(good, board, size_px) if good else None
    used = good if solution is None else [view.sighting for view in solution.views]
    K, lens = (None, None) if solution is None else (solution.K, solution.distortion)
    seen = coverage(used, board, size_px, limits.needs, K, lens)
    faults = [*_set_faults(pictures, seen, board, limits)]
    if solution is not None:
        faults += _solution_faults(solution, limits)
    elif not faults:
        faults.append("no camera explains these pictures; is --board the size in inner corners, and is the board flat?")
    return Result(tuple(pictures), solution, seen, tuple(faults))


def _set_faults(pictures: Sequence[Picture], seen: Coverage, board: Board, limits: Limits) -> list[str]:
    faults = []
    needs = limits.needs
    if seen.views < needs.views:
        bad: dict[str, int] = {}
        for picture in pictures:
            if picture.fault:
                kind = picture.fault.split(":")[0]
                bad[kind] = bad.get(kind, 0) + 1
        lost = ", ".join(f"{count} {kind}" for kind, count in bad.items())
        faults.append(
            f"only {seen.views} of {len(pictures)} pictures can be used, {needs.views} are needed"
            + (f" ({lost})" if lost else "") + f": {_advice(bad, board)}"
        )  # fmt: skip
    if seen.views and seen.covered < needs.covered:
        faults.append(
            f"corners in {seen.covered:.0%} of the picture, {needs.covered:.0%} needed: {seen.hints(needs)[0]}, "
            "and nearer, until all corners of the picture are reached"
        )
    if seen.views and min(seen.turned, seen.tipped) < needs.tilted:
        faults.append(
            f"the board is turned in {seen.turned} and tipped in {seen.tipped} pictures, {needs.tilted} of each needed: "
            "frontal pictures cannot tell focal length from distance; turn and tip it by 20 to 40 degrees"
        )
    return faults


def _advice(bad: dict[str, int], board: Board) -> str:
    if not bad:
        return "take more"
    if max(bad, key=lambda kind: bad[kind]) == "blurred":
        return "hold the board still, give it more light, focus"
    return (
        f"show the whole board, evenly lit; it must have {board.columns} x {board.rows} inner corners, that is "
        f"{board.columns + 1} x {board.rows + 1} squares (else name them with --board)"
    )


def _solution_faults(solution: Solution, limits: Limits) -> list[str]:
    width, height = solution.size_px
    fx, fy, cx, cy = solution.K[0, 0], solution.K[1, 1], solution.K[0, 2], solution.K[1, 2]
    faults = []
    limit_px = scale(width) * limits.rms_px
    if solution.rms_px > limit_px:
        faults.append(
            f"reprojection error {solution.rms_px:.2f} px, at most {limit_px:.2f}: is the board flat, still and in focus, "
            "and --board right?"
        )
    sigma = max(solution.sigma[0] / fx, solution.sigma[1] / fy)
    if not sigma <= limits.focal_sigma:
        faults.append(
            f"the focal length is known to {sigma:.2%} only, {limits.focal_sigma:.2%} needed: more pictures, tilted more "
            "and nearer"
        )
    off = max(abs(cx - width / 2.0), abs(cy - height / 2.0)) / width
    if off > limits.centre_share:
        faults.append(
            f"the principal point ({cx:.0f} {cy:.0f}) is far from the picture's middle: tilt the board in all directions"
        )
    if not _unfolded(solution):
        faults.append("the distortion is not known at the picture's border: hold the board into the picture's corners")
    return faults


def _unfolded(solution: Solution) -> bool:
    """Return whether the lens model keeps the order of radii out to the picture's corners (it must not fold)."""
    width, height = solution.size_px
    k1, k2, _, _, k3 = solution.distortion
    x = np.array([0.0, width]) - solution.K[0, 2]
    y = np.array([0.0, height]) - solution.K[1, 2]
    farthest = float(np.hypot(np.abs(x).max() / solution.K[0, 0], np.abs(y).max() / solution.K[1, 1]))
    r = np.linspace(0.0, 1.5 * farthest, 400)
    distorted = r * (1.0 + r**2 * (k1 + r**2 * (k2 + r**2 * k3)))
    rising = np.flatnonzero(np.diff(distorted) <= 0.0)
    return len(rising) == 0 or float(distorted[: rising[0] + 1].max()) >= farthest
