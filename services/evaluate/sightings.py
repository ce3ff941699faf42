"""What a report tells of the target in each frame, as rows of numbers: 3.5 MB an hour, a tenth of the messages'."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from schemas.trees import Target

SIGHTING = np.dtype([
    ("stamp_ns", np.int64), ("tree_id", np.int64), ("tracking", np.bool_), ("image_x_px", np.float64), ("range_m", np.float64),
    ("radius_m", np.float64), ("raw_image_x_px", np.float64), ("raw_range_m", np.float64), ("raw_radius_m", np.float64),
])  # fmt: skip
"""NaN and -1 stand for what the message leaves open."""
Sightings = NDArray[np.void]
_VALUES = SIGHTING.names[3:] if SIGHTING.names else ()


def sighting(target: Target) -> tuple[int | bool | float, ...]:
    """Return a message's row."""
    values = (getattr(target, name) for name in _VALUES)
    tree_id = -1 if target.tree_id is None else target.tree_id
    return (
        target.stamp_ns, tree_id, target.status == "tracking", *(math.nan if v is None else v for v in values)
    )  # fmt: skip


def sightings(targets: Sequence[Target] = ()) -> Sightings:
    """Return the messages' rows, (N,) of ``SIGHTING``."""
    return np.array([sighting(target) for target in targets], SIGHTING)
