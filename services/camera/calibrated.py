"""When a camera was calibrated, without loading what reads cameras."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path


def calibrated_on(path: Path) -> dt.date | None:
    """Return the day on which calibrate wrote a camera.json; None when it does not say, or cannot be read.

    The file's own time is no witness: a copy has another.
    """
    try:
        return dt.date.fromisoformat(json.loads(path.read_text(encoding="utf-8-sig"))["calibration"]["day"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
