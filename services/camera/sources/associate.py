"""Which depth image belongs to which colour image, by their stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_NEAREST = 8
"""So many depth images on each side are looked at: were all stamps alike, each would be as near as every other."""


def associate(colour_ns: NDArray[np.int64], depth_ns: NDArray[np.int64], within_ns: int) -> list[tuple[int, int]]:
    """Pair colour and depth stamps: nearest first, each used once, none further apart than ``within_ns``.

    Args:
        colour_ns: (N,) stamps, any order.
        depth_ns: (M,) stamps, any order.
        within_ns: the largest difference.

    Returns:
        Index pairs (colour, depth) in the order of the colour stamps.
    """
    order = np.argsort(depth_ns, kind="stable")
    ordered = depth_ns[order]
    candidates = []
    for i, stamp in enumerate(colour_ns):
        first, here, last = np.searchsorted(ordered, [stamp - within_ns, stamp, stamp + within_ns + 1])
        first, last = max(first, here - _NEAREST), min(last, here + _NEAREST)
        candidates += [(abs(int(ordered[k]) - int(stamp)), int(stamp), i, int(order[k])) for k in range(first, last)]
    used_colour: set[int] = set()
    used_depth: set[int] = set()
    pairs = []
    for _, stamp, i, k in sorted(candidates):
        if i not in used_colour and k not in used_depth:
            used_colour.add(i)
            used_depth.add(k)
            pairs.append((stamp, i, k))
    return [(i, k) for _, i, k in sorted(pairs)]


def unpaired(colour_ns: NDArray[np.int64], depth_ns: NDArray[np.int64], within_ns: int) -> str:
    """Return why not one colour image has its depth image, with the usual distance between the two."""
    if not len(colour_ns) or not len(depth_ns):
        return f"{len(colour_ns)} colour and {len(depth_ns)} depth images"
    ordered = np.sort(depth_ns)
    after = np.searchsorted(ordered, colour_ns)
    beside = (ordered[np.maximum(after - 1, 0)], ordered[np.minimum(after, len(ordered) - 1)])
    apart_ms = float(np.median(np.minimum(*(np.abs(colour_ns - near) for near in beside)))) / 1e6
    return (
        f"no colour image has a depth image within {within_ns / 1e6:.0f} ms; the nearest is usually {apart_ms:.0f} ms "
        "away: are the stamps of one of the two shifted? (camera.associate_within_s)"
    )
