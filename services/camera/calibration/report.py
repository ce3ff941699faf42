"""camera.json and the lines that tell a calibration."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from services.camera.calibration.board import Board
from services.camera.calibration.extrinsics import Mounting
from services.camera.calibration.judge import Limits, Result
from services.camera.calibration.solve import Solution

_NAMES = ("k1", "k2", "p1", "p2", "k3")


def camera_values(
    solution: Solution, board: Board, depth_scale: float, mount: Mounting | None = None, day: str = ""
) -> dict[str, Any]:
    """Return the content of camera.json: what process and the services read, and how and on which ``day`` it was come by."""
    width, height = solution.size_px
    K = solution.K
    values: dict[str, Any] = {
        "width": width, "height": height, "fx": _r(K[0, 0]), "fy": _r(K[1, 1]), "cx": _r(K[0, 2]), "cy": _r(K[1, 2]),
        **{name: _r(value, 8) for name, value in zip(_NAMES, solution.distortion, strict=True)},
        "depth_scale": depth_scale,
    }  # fmt: skip
    if mount is not None:
        values["T_body_camera"] = [[_r(v, 9) for v in row] for row in mount.T_body_camera]
    values["calibration"] = {
        **({"day": day} if day else {}),
        "board": f"{board.kind} {board.columns}x{board.rows} inner corners, {board.square_m:g} m squares",
        "pictures": len(solution.views), "reprojection_px": _r(solution.rms_px, 4),
        "sigma_fx_px": _r(solution.sigma[0], 4), "sigma_fy_px": _r(solution.sigma[1], 4),
    }  # fmt: skip
    return values


def camera_bytes(values: dict[str, Any]) -> bytes:
    """Return camera.json."""
    return (json.dumps(values, indent=1, allow_nan=False) + "\n").encode()


def report_lines(result: Result, limits: Limits) -> list[str]:
    """Return what was found, for people."""
    used = 0 if result.solution is None else len(result.solution.views)
    lines = [f"{used} of {len(result.pictures)} pictures used"]
    s = result.solution
    if s is not None:
        if s.left_out:
            good = [p.name for p in result.pictures if p.sighting is not None]
            lines.append("left out, they do not fit the others: " + ", ".join(good[k] for k in s.left_out))
        lines += [
            f"fx {s.K[0, 0]:.2f} ± {s.sigma[0]:.2f}  fy {s.K[1, 1]:.2f} ± {s.sigma[1]:.2f}  "
            f"cx {s.K[0, 2]:.2f} ± {s.sigma[2]:.2f}  cy {s.K[1, 2]:.2f} ± {s.sigma[3]:.2f} px",
            "  ".join(f"{name} {value:.5f}" for name, value in zip(_NAMES, s.distortion, strict=True)),
            f"reprojection error {s.rms_px:.3f} px; corners in {result.coverage.covered:.0%} of the picture; "
            f"{result.coverage.turned} turned, {result.coverage.tipped} tipped",
            f"limits: {limits.told(s.size_px[0])}",
        ]
    return lines


def mount_lines(mount: Mounting) -> list[str]:
    """Return how the camera sits, and the configuration that says so."""
    roll, pitch, yaw = mount.angles_rad
    x, y, z = mount.offset_m
    return [
        f"camera on the body: {x:.3f} forward, {y:.3f} left, {z:.3f} up (m); roll {np.degrees(roll):.2f}, "
        f"pitch {np.degrees(pitch):.2f} down, yaw {np.degrees(yaw):.2f} left (degrees)",
        f"for the autopilot bridge: --set autopilot.camera_offset_m=[{x:.4f},{y:.4f},{z:.4f}] "
        f"--set autopilot.camera_pitch_rad={pitch:.5f} --set autopilot.camera_yaw_rad={yaw:.5f}",
    ]


def _r(value: float, digits: int = 6) -> float:
    return round(float(value), digits)
