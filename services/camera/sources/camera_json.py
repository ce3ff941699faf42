"""camera.json: the intrinsics of a recording."""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import ValidationError

from schemas.camera import Intrinsics
from services.common.errors import InputError

_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy", "depth_scale")


def read_intrinsics(path: Path) -> Intrinsics:
    """Return the intrinsics in ``path``.

    Raises:
        InputError: naming the file, the field, its value and what was expected.
    """
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
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
        first = error.errors(include_url=False)[0]
        field = ".".join(str(part) for part in first["loc"])
        raise InputError(f"{path}: {field}: {first['msg']} (found {str(first['input'])[:40]!r})") from None
    for name, value, side in (("cx", intrinsics.cx, intrinsics.width), ("cy", intrinsics.cy, intrinsics.height)):
        if not 0.0 <= value <= side:
            raise InputError(f"{path}: {name}: {value} is outside the image of {side} px")
    return intrinsics
