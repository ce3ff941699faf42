"""Do depth and colour show the same moment? A trunk's edges in both images tell.

While the camera turns, a depth image that is late by ``lag`` shows the trunk where it was: its edges in colour are
``speed * lag`` pixels beside those in depth. The speed is known from the poses, so each frame of a moving camera gives a
lag; frames of a still one give the fixed offset, a fault of the registration. A frame whose offset is large while the
camera moves is not believed at once; told as a fault is only what many frames agree on.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from services.detector.refine import kernels_colour
from services.detector.refine.config import AgreementConfig

Colour = NDArray[np.uint8]
_MIN_AGREED = 0.6
_LIKE = 0.5
_APART_NS = 300_000_000
_STILL_SHARE = 0.3


@dataclass(frozen=True, slots=True)
class Offset:
    """Where colour shows the trunk, less where depth does, px; and how fast the camera's motion moves it, px/s."""

    stamp_ns: int
    offset_px: float
    speed_px_s: float


class ColourAgreement:
    """Collects offsets and says what is wrong, in words, or nothing."""

    def __init__(self, config: AgreementConfig) -> None:
        self._config = config
        self._still: deque[float] = deque(maxlen=config.frames)
        self._moving: deque[Offset] = deque(maxlen=config.frames)
        self._profiles = np.empty((2, 2 * config.reach_px + 1))
        self._out = np.empty(3)
        self._lag_s = 0.0
        self._fixed_px = 0.0
        self.fault = ""
        """What many frames agree on; kept until they agree that it is over."""

    def see(self, stamp_ns: int, colour: Colour, edges_px: NDArray[np.int64], speed_px_s: float | None) -> str:
        """Take the trunk's edges in one frame; return why the frame is not to be believed, or nothing.

        Args:
            stamp_ns: The frame's.
            colour: (H, W, 3).
            edges_px: (N, 3) row, left and right column of the edges in the depth image, -1 where there is none.
            speed_px_s: How fast the camera's motion moves the trunk in the image; None when that is not known.
        """
        config = self._config
        rows = kernels_colour.edge_profiles(colour, edges_px, config.reach_px, self._profiles)
        kernels_colour.best_offset(self._profiles, config.widest_px, self._out)
        offset, _, contrast = self._out.tolist()
        clear = rows >= config.min_edges and contrast >= config.min_contrast
        if speed_px_s is None:
            apart = clear and abs(offset - self._fixed_px) > config.max_offset_px
            return self.fault if self._lag_s else _apart(offset) if apart else ""
        seen = Offset(stamp_ns, offset, speed_px_s) if clear else None
        moving = abs(speed_px_s) > config.moving_px_s
        refusal = self._refusal(seen if moving else None, speed_px_s)
        if seen is not None:
            self._take(seen)
        return refusal

    def _refusal(self, seen: Offset | None, speed_px_s: float) -> str:
        """Return why a frame is not believed: a known lag, or of a moving camera its own offset and the last one's."""
        limit = self._config.max_offset_px
        if self._lag_s and abs(speed_px_s * self._lag_s) > limit:
            return self.fault
        if seen is None or abs(seen.offset_px - self._fixed_px) <= limit:
            return ""
        last = self._moving[-1] if self._moving else None
        if last is not None and seen.stamp_ns - last.stamp_ns < _APART_NS:
            mine, other = self._lag_of(seen), self._lag_of(last)
            if abs(mine - other) > _LIKE * max(abs(mine), abs(other)):
                return ""
        return _apart(seen.offset_px)

    def _lag_of(self, seen: Offset) -> float:
        return (seen.offset_px - self._fixed_px) / seen.speed_px_s

    def _take(self, seen: Offset) -> None:
        config = self._config
        if abs(seen.speed_px_s) > config.moving_px_s:
            self._moving.append(seen)
        elif abs(seen.speed_px_s) < _STILL_SHARE * config.moving_px_s:
            self._still.append(seen.offset_px)
        if len(self._still) >= config.min_frames:
            self._fixed_px = float(np.median(self._still))
        if len(self._moving) >= config.min_frames:
            lags = np.array([self._lag_of(one) for one in self._moving])
            lag = float(np.median(lags))
            least = config.max_lag_s * (0.5 if self._lag_s else 1.0)
            agreed = float(np.mean(np.abs(lags - lag) <= _LIKE * abs(lag)))
            self._lag_s = lag if abs(lag) > least and agreed >= _MIN_AGREED else 0.0
        self.fault = self._words()

    def _words(self) -> str:
        if self._lag_s:
            order = "older" if self._lag_s > 0.0 else "newer"
            return (
                f"the depth image is {1e3 * abs(self._lag_s):.0f} ms {order} than the colour image it comes with: "
                "synchronise the two streams"
            )
        if abs(self._fixed_px) > self._config.max_offset_px:
            return f"depth lies {abs(self._fixed_px):.0f} px beside colour: calibrate, or register depth to colour anew"
        return ""


def _apart(offset_px: float) -> str:
    return f"depth and colour show the trunk {abs(offset_px):.0f} px apart"
