"""camera.json: the calibration of a camera: intrinsics and, if known, how it sits on the aircraft or by another camera."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.camera import Intrinsics
from services.common.errors import InputError

_TRANSFORMS = ("T_body_camera", "T_colour_depth")
_ROTATION_TOLERANCE = 1e-4
_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")
_MIN_FOCAL, _MAX_FOCAL = 0.05, 100.0
"""Focal length in image sides: views from 169 down to half a degree wide."""


@dataclass(frozen=True, slots=True)
class CameraFile:
    """What a camera.json holds."""

    intrinsics: Intrinsics
    T_body_camera: NDArray[np.float64] | None = None
    """(4, 4): camera points in body (forward, left, up)."""
    T_colour_depth: NDArray[np.float64] | None = None
    """(4, 4), of a depth camera: its points in the colour camera."""


def read_intrinsics(path: Path) -> Intrinsics:
    """Return the intrinsics in ``path``.

    Raises:
        InputError: naming the file, the field, its value and what was expected.
    """
    return read_camera(path).intrinsics


def read_camera(path: Path) -> CameraFile:
    """Return all that ``path`` holds; ``calibration``, the report that calibrate leaves there, is not looked at.

    Raises:
        InputError: naming the file, the field, its value and what was expected.
    """
    body = _object(path)
    body.pop("calibration", None)
    transforms = {name: _transform(path, name, body.pop(name, None)) for name in _TRANSFORMS}
    missing = [name for name in _REQUIRED if name not in body]
    if missing:
        raise InputError(f"{path}: {', '.join(missing)} missing")
    try:
        intrinsics = Intrinsics.model_validate(body)
    except ValidationError as error:
        raise InputError(f"{path}: {_fault(error)}") from None
    i = intrinsics
    for axis, focal_px, centre_px, side_px in (("x", i.fx, i.cx, i.width), ("y", i.fy, i.cy, i.height)):
        if not 0.0 <= centre_px <= side_px:
            raise InputError(f"{path}: c{axis}: {centre_px} is outside the image of {side_px} px")
        if not _MIN_FOCAL * side_px <= focal_px <= _MAX_FOCAL * side_px:
            raise InputError(f"{path}: f{axis}: {focal_px} px is no focal length for an image of {side_px} px")
    return CameraFile(intrinsics, **transforms)


def _object(path: Path) -> dict[str, Any]:
    try:
        body = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; name the camera's intrinsics with --camera FILE") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not JSON: {error}") from None
    if not isinstance(body, dict):
        raise InputError(f"{path}: expected an object with {', '.join(_REQUIRED)}, found {type(body).__name__}")
    return body


def _transform(path: Path, name: str, rows: object) -> NDArray[np.float64] | None:
    """Return a rigid transform, None where there is none."""
    if rows is None:
        return None
    try:
        T = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.zeros(0)
    rigid = T.shape == (4, 4) and np.all(np.isfinite(T)) and np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0])
    if not rigid or np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(T) < 0.0:
        raise InputError(f"{path}: {name}: expected four rows of four numbers, a rotation and a shift in metres")
    return T


def _fault(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"{field}: unknown name; known are {', '.join(Intrinsics.model_fields)}"
    hint = "; units per metre were expected, 1000 for millimetres" if field == "depth_scale" else ""
    return f"{field}: {first['msg']} (found {repr(first['input'])[:40]}{hint})"
