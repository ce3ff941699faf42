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


class Relocation:
    """Finds frames blind; in doubt one is not believed before a second was found where the camera can be by then."""

    def __init__(self, loops: Loops, verifier: Verifier) -> None:
        self._loops = loops
        self._verifier = verifier
        self._found: tuple[int, Tracked] | None = None
        """Stamp and frame of a place that waits for a second frame to say the same."""

    def find(self, stamp_ns: int, features: Features, depth_m: NDArray[np.float32]) -> Tracked | None:
        """Return the frame located anywhere in the map, None when it is not, or not believed yet; ``depth_m`` (H, W)."""
        frame = self._loops.relocate(features)
        if (
            frame is None
            or position_sigma_m(frame) > _SIGMA_MOST_M
            or not self._verifier.believes(frame, depth_m, blind=True)
        ):
            self._found = None
            return None
        before, self._found = self._found, (stamp_ns, frame)
        again = before is not None and can_have_moved((stamp_ns - before[0]) * 1e-9, step_between(before[1], frame))
        if not again and not self._verifier.sure(frame):
            return None
        self._found = None
        return frame


def position_sigma_m(frame: Tracked) -> float:
    """Return the standard deviation of where the camera is, in its worst direction; infinite where nothing tells it."""
    if frame.information is None or not np.isfinite(frame.information).all():
        return np.inf
    covariance = np.linalg.inv(frame.information + 1e-9 * np.eye(6))
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))


def step_between(last: Tracked, frame: Tracked) -> F64:
    """Return T_last_camera (4, 4) of two located frames."""
    return pose(last.R, last.t) @ inverse(pose(frame.R, frame.t))
