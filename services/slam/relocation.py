"""A lost frame's place in the map, and when it is believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import inverse, pose
from services.slam.features import Features
from services.slam.loops import Loops
from services.slam.motion import can_have_moved
from services.slam.tracking import Tracked
from services.slam.verify import Verifier

F64 = NDArray[np.float64]

_SIGMA_MOST_M = 0.5
"""A place known worse is none: where hardly anything near is seen the far points tell the direction alone, and the less the
farther away the place is said to be, the more they agree with it."""

_VOUCHES_S = 0.5
"""So long a place found, but not believed yet, speaks for one that agrees with it: in a minute the camera can be anywhere."""


class Relocation:
    """Finds frames blind; in doubt one is not believed before a second was found where the camera can be by then."""

    def __init__(self, loops: Loops, verifier: Verifier) -> None:
        self._loops = loops
        self._verifier = verifier
        self._found: tuple[int, Tracked] | None = None
        """Stamp and frame of a place that waits for a second frame to say the same."""

    def find(self, stamp_ns: int, features: Features, depth_m: NDArray[np.float32]) -> Tracked | None:
        """Return the frame located anywhere in the map, None when it is not, or not believed yet; ``depth_m`` (H, W)."""
        places = self._loops.relocate(features)
        frame = next((place for place in places if self._fit(place, depth_m)), None)
        before, self._found = self._found, None
        if frame is None or self._verifier.sure(frame) or _again(before, stamp_ns, frame):
            return frame
        self._found = stamp_ns, frame
        return None

    def forget(self) -> None:
        """Let the next place found be the first: the camera was located otherwise since the last."""
        self._found = None

    def _fit(self, frame: Tracked, depth_m: NDArray[np.float32]) -> bool:
        return position_sigma_m(frame) <= _SIGMA_MOST_M and self._verifier.believes(frame, depth_m, blind=True)


def _again(before: tuple[int, Tracked] | None, stamp_ns: int, frame: Tracked) -> bool:
    """Return whether the place found ``before``, at its stamp, is one from which the camera can have come just now."""
    if before is None:
        return False
    dt_s = (stamp_ns - before[0]) * 1e-9
    return 0.0 < dt_s <= _VOUCHES_S and can_have_moved(dt_s, step_between(before[1], frame))


def position_sigma_m(frame: Tracked) -> float:
    """Return the standard deviation of where the camera is, in its worst direction; infinite where nothing tells it."""
    if frame.information is None or not np.isfinite(frame.information).all():
        return np.inf
    covariance = np.linalg.inv(frame.information + 1e-9 * np.eye(6))
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))


def step_between(last: Tracked, frame: Tracked) -> F64:
    """Return T_last_camera (4, 4) of two located frames."""
    return pose(last.R, last.t) @ inverse(pose(frame.R, frame.t))
