"""camera.json: the intrinsics of a recording."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from schemas.camera import Intrinsics
from services.common.errors import InputError

_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")
_MIN_FOCAL, _MAX_FOCAL = 0.05, 100.0
"""Focal length in image sides: views from 169 down to half a degree wide."""


def read_intrinsics(path: Path) -> Intrinsics:
    """Return the intrinsics in ``path``.

    Raises:
        InputError: naming the file, the field, its value and what was expected.
    """
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
    return intrinsics


def _fault(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    field = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"{field}: unknown name; known are {', '.join(Intrinsics.model_fields)}"
    hint = "; units per metre were expected, 1000 for millimetres" if field == "depth_scale" else ""
    return f"{field}: {first['msg']} (found {repr(first['input'])[:40]}{hint})"
