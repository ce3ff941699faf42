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
_GAP_S, _GAP_FRAMES = 0.5, 3.0
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


def begins(seen: Sightings, shown: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return for each of the ``shown`` rows whether a line begins anew with it: another tree, or none for a while.

    How long a while is follows from how often anything was ``seen``: a long flight's rows are thinned.
    """
    often_s = 1e-9 * float(np.median(np.diff(seen["stamp_ns"]))) if len(seen) > 1 else 0.0
    rows = seen[shown]
    late = np.diff(rows["stamp_ns"]) > 1e9 * max(_GAP_S, _GAP_FRAMES * often_s)
    return np.concatenate([np.ones(min(len(rows), 1), np.bool_), late | (np.diff(rows["tree_id"]) != 0)])
