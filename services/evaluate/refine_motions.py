"""The reference's three motions before one tree: what the Kalman filters make of the raw measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from services.common.geometry import R_BODY_CAMERA, Matrix, exp_rotation, pose, rotation_z
from services.detector.refine.config import RefinerConfig
from services.detector.refine.model import ExpectedTree
from services.detector.refine.tracker import RefinerTracker
from services.detector.refine.view import axis_point, project_point
from services.simulator.render import DEFAULT_INTRINSICS

RATE_HZ = 15.0
DURATION_S = 5.0
HIDDEN_S = (3.0, 4.0)
"""In the fourth motion the trunk is hidden for this long."""
_JITTER = (0.003, 0.003, 0.003, 0.001, 0.001, 0.001)
"""Of the pose from frame to frame, metres and radians."""


@dataclass(frozen=True, slots=True)
class MotionRow:
    """One motion: per frame (N,) stamps, and image x (px), range (m), radius (m): true, raw and filtered (N, 3)."""

    name: str
    t_s: Matrix
    true: Matrix
    raw: Matrix
    """NaN where the frame was not measured."""
    filtered: Matrix
    """NaN where the target was lost."""
    sigma: Matrix
    """Of ``filtered``, as told."""
    mapped: Matrix
    """What the map alone says."""
    nis: Matrix
    """Normalised squared innovations of the filters, NaN where none was accepted."""
    status: tuple[str, ...]

    def figures(self) -> dict[str, float]:
        """Return errors of raw and filtered values, and their jitter: the spread of steps against the truth's."""
        out: dict[str, float] = {}
        for k, (what, unit) in enumerate((("x", "px"), ("range", "m"), ("radius", "m"))):
            for kind, values in (("raw", self.raw), ("filtered", self.filtered)):
                error = values[:, k] - self.true[:, k]
                out[f"{self.name}_{what}_{kind}_rmse_{unit}"] = float(np.sqrt(np.nanmean(error**2)))
                out[f"{self.name}_{what}_{kind}_jitter_{unit}"] = float(np.nanstd(np.diff(error)))
            error = (self.filtered[:, k] - self.true[:, k]) / self.sigma[:, k]
            out[f"{self.name}_{what}_nees"] = float(np.nanmean(error**2))
            out[f"{self.name}_{what}_nis"] = float(np.nanmean(self.nis[:, k]))
        if self.name == "hidden":
            out |= self._hidden_figures()
        return out

    def _hidden_figures(self) -> dict[str, float]:
        after = [t for t, s in zip(self.t_s, self.status, strict=True) if t > HIDDEN_S[0] and s == "lost"]
        lost_s = min(after) - HIDDEN_S[0] if after else math.nan
        found = self.t_s[(self.t_s > HIDDEN_S[1]) & ~np.isnan(self.raw[:, 0])]
        found_s = float(found.min()) - HIDDEN_S[1] if len(found) else math.nan
        figures = {"lost_after_s": float(lost_s), "found_after_s": found_s}
        return {name: value for name, value in figures.items() if math.isfinite(value)}

    def line(self) -> str:
        """Return the row as one line."""
        f = self.figures()
        n = self.name
        text = (
            f"{n}: image x jitter {f[f'{n}_x_raw_jitter_px']:.2f} -> {f[f'{n}_x_filtered_jitter_px']:.2f} px, "
            f"range {1000 * f[f'{n}_range_raw_jitter_m']:.1f} -> {1000 * f[f'{n}_range_filtered_jitter_m']:.1f} mm, "
            f"radius {1000 * f[f'{n}_radius_raw_jitter_m']:.1f} -> {1000 * f[f'{n}_radius_filtered_jitter_m']:.1f} mm; "
            f"measured {int(np.sum(~np.isnan(self.raw[:, 0])))} of {len(self.t_s)}"
        )
        if n == "hidden":
            said, found = (f"{f[k]:.2f} s" if k in f else "never" for k in ("lost_after_s", "found_after_s"))
            text += f"; said lost after {said}, found after {found} of being free"
        return text


def _left_right(t: float) -> tuple[float, float, float]:
    return 0.0, 0.5 * math.sin(1.2 * t), 0.15 * math.sin(0.9 * t)


def _forward_back(t: float) -> tuple[float, float, float]:
    return 0.8 - 0.8 * math.cos(0.8 * t), 0.0, 0.02 * math.sin(2.0 * t)


def _random(t: float) -> tuple[float, float, float]:
    x = 0.4 * math.sin(0.9 * t + 1.0) + 0.2 * math.sin(2.3 * t)
    y = 0.3 * math.sin(1.4 * t) + 0.15 * math.sin(2.9 * t + 2.0)
    return x, y, 0.1 * math.sin(1.9 * t + 0.5) + 0.05 * math.sin(4.1 * t)


def _still(t: float) -> tuple[float, float, float]:
    return 0.0, 0.05 * math.sin(t), 0.0


MOTIONS: dict[str, Callable[[float], tuple[float, float, float]]] = {
    "left_right": _left_right, "forward_back": _forward_back, "random": _random, "hidden": _still,
}  # fmt: skip
"""Forward (m), left (m) and yaw (rad) as functions of time (s), from 2.6 m before the tree."""


def motion_rows(seed: int, *, quick: bool = False) -> list[MotionRow]:
    """Return the motions before the tree of a fresh single scene."""
    return [_motion(name, seed, 0.25 if quick else 1.0) for name in MOTIONS]


def _motion(name: str, seed: int, share: float) -> MotionRow:
    from services.simulator.camera import SimulatedCamera
    from services.simulator.catalogue import random_scene
    from services.simulator.config import SensorConfig
    from services.simulator.world import World

    scene = random_scene(77_000 + seed, "single")
    tree = next(tree for tree in scene.trees if tree.suitable)
    camera = SimulatedCamera(World(scene), SensorConfig(), seed=seed)
    rng = np.random.default_rng([seed, 402])
    told = ExpectedTree(0, tree.x_m + 0.03, tree.y_m - 0.03, tree.z_m, tree.axis, tree.radius_m + 0.008, 0.04, 0.01)
    tracker = RefinerTracker(RefinerConfig())
    tracker.set_trees([told], [0], "bench", 0)
    heading = math.atan2(tree.y_m, tree.x_m)
    rows: list[tuple[float | tuple[float, ...], ...]] = []
    status: list[str] = []
    for k in range(int(DURATION_S * RATE_HZ * (share if name != "hidden" else 1.0))):
        t = k / RATE_HZ
        T = _camera(tree.centre_at(1.5)[:2], heading, MOTIONS[name](t), scene.ground.at(0.0, 0.0))
        depth = camera.look(T, k).depth.astype(np.float32) / np.float32(1000.0)
        if name == "hidden" and HIDDEN_S[0] < t < HIDDEN_S[1]:
            depth[:, 200:440] = 0.8
        error = rng.normal(0.0, _JITTER)
        jittered = pose(exp_rotation(error[3:]) @ T[:3, :3], T[:3, 3] + error[:3])
        state = tracker.step(round(t * 1e9), depth, DEFAULT_INTRINSICS, jittered, np.diag(np.square(_JITTER)) * 4.0)
        at = float(T[2, 3]) - tree.z_m
        true = _as_seen(tree.centre_at(at)[:2], T, tree.radius_m)
        mapped = _as_seen(axis_point(told, float(jittered[2, 3])), jittered, told.radius_m)
        raw = _numbers(state.raw_image_x_px, state.raw_range_m, state.raw_radius_m)
        filtered = _numbers(state.image_x_px, state.range_m, state.radius_m)
        sigma = _numbers(state.sigma_bearing_rad, state.sigma_range_m, state.sigma_radius_m)
        sigma = (sigma[0] * DEFAULT_INTRINSICS.fx, *sigma[1:])
        nis = _numbers(*(tracker.innovations2 or (None,) * 3)) if state.measured else _numbers(None, None, None)
        rows.append((t, true, raw, filtered, sigma, mapped, nis))
        status.append(state.status)
    t_s, true_v, raw_v, filtered_v, sigma_v, mapped_v, nis_v = (
        np.array([row[j] for row in rows], dtype=np.float64) for j in range(7)
    )
    return MotionRow(name, t_s, true_v, raw_v, filtered_v, sigma_v, mapped_v, nis_v, tuple(status))


def _as_seen(place_m: Matrix, T: Matrix, radius_m: float) -> tuple[float, float, float]:
    """Return image x (px), range (m) and radius of a trunk at ``place_m`` (2,) in map."""
    offset = place_m - T[:2, 3]
    x, y, z = (offset @ T[:2, :3]).tolist()
    return project_point(x, y, z, DEFAULT_INTRINSICS)[0], float(np.hypot(offset[0], offset[1])), radius_m


def _numbers(*values: float | None) -> tuple[float, ...]:
    return tuple(math.nan if value is None else float(value) for value in values)


def _camera(place_m: Matrix, heading: float, moved: tuple[float, float, float], ground_m: float) -> Matrix:
    """Return the camera's pose: 2.6 m before the tree, moved forward and left, turned."""
    away = np.array([math.cos(heading), math.sin(heading)])
    left = np.array([-away[1], away[0]])
    position = place_m - (2.6 - moved[0]) * away + moved[1] * left
    return pose(rotation_z(heading + moved[2]) @ R_BODY_CAMERA, [position[0], position[1], ground_m + 1.5])


def plot_motions(rows: Sequence[MotionRow], path: Path) -> str:
    """Draw the motions, and what of them the raw and the filtered values miss; return the file's name, or why not."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return "none: matplotlib is not installed"
    figure = Figure(figsize=(15, 2.7 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), 4, squeeze=False, sharex="row")
    for row, line in zip(rows, axes, strict=True):
        name = row.name.replace("_", " / ")
        line[0].plot(row.t_s, row.true[:, 0], color="black", linewidth=2.5, alpha=0.3, label="true")
        line[0].plot(row.t_s, row.raw[:, 0], ".", color="tab:red", markersize=3, label="raw")
        line[0].plot(row.t_s, row.filtered[:, 0], color="tab:blue", linewidth=1.0, label="filtered")
        line[0].set_title(f"{name}: image x (px)", fontsize=10)
        for k, (what, scale) in enumerate((("image x (px)", 1.0), ("range (mm)", 1e3), ("radius (mm)", 1e3))):
            _plot_error(line[k + 1], row, k, scale)
            line[k + 1].set_title(f"{name}: error of {what}", fontsize=10)
    for panel in axes[-1]:
        panel.set_xlabel("s")
    axes[0][0].legend(fontsize=8, loc="best")
    axes[0][2].legend(fontsize=8, loc="best")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=72)
    return path.name


def _plot_error(panel: Any, row: MotionRow, k: int, scale: float) -> None:  # noqa: ANN401 - matplotlib
    """Draw raw and filtered less true, the filter's own two sigma about zero, and the map's word."""
    sigma, mapped = 2.0 * scale * row.sigma[:, k], scale * (row.mapped[:, k] - row.true[:, k])
    raw, filtered = (scale * (values[:, k] - row.true[:, k]) for values in (row.raw, row.filtered))
    panel.fill_between(row.t_s, -sigma, sigma, color="tab:blue", alpha=0.12, linewidth=0, label="2 sigma as told")
    panel.plot(row.t_s, mapped, color="tab:green", linewidth=0.8, alpha=0.8, label="map (cloud)")
    panel.plot(row.t_s, raw, ".", color="tab:red", markersize=3, label="raw")
    panel.plot(row.t_s, filtered, color="tab:blue", linewidth=1.0, label="filtered")
    panel.axhline(0.0, color="black", linewidth=0.5)
    reach = 1.15 * float(np.nanmax(np.abs(np.concatenate([raw, sigma, mapped]))))
    panel.set_ylim(-reach, reach)
