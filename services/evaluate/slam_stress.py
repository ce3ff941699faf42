"""Faults on rendered turns, pure and seeded: what the camera delivers while something goes wrong, and whether slam is back.

A case plays three seconds of a turn, then the fault, then two seconds more. After a blackout the camera looks 0.7 to 1.5 s
back along its turn: it has moved while blind, to a place that the map knows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.evaluate.slam_turns import Heard, Shot, Turn, listen, mean_alignment, pose_errors
from services.slam.config import SlamConfig
from services.slam.slam import Slam

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]
Images = tuple[U8, F32]

RATE_HZ = 15.0
BEFORE, AFTER = 45, 30
"""Frames."""
RECOVER_S = 1.0
LIMIT_M = 0.05
MOMENTS = (60, 270)
"""Frames of a turn between which faults begin."""


@dataclass(frozen=True, slots=True)
class Fault:
    """What goes wrong, for how long."""

    frames: int
    spoil: Callable[[Shot, int, np.random.Generator], Images | None]
    """(frame, its number in the fault, the case's generator) -> images, None: the frame is dropped."""
    back: bool = False
    """Whether the camera has moved when the fault ends."""


def blackout(shot: Shot, index: int, rng: np.random.Generator) -> Images:
    """Nothing is seen: noise of the sensor in the dark, no depth."""
    del index
    return rng.integers(0, 4, shot.grey.shape, dtype=np.uint8), np.zeros_like(shot.depth_m)


def dropped(shot: Shot, index: int, rng: np.random.Generator) -> Images | None:
    """Three frames in ten never come."""
    del index
    return None if rng.random() < 0.3 else (shot.grey, shot.depth_m)


def motion_blur(shot: Shot, index: int, rng: np.random.Generator) -> Images:
    """Smear over 12 to 30 pixels, as a long exposure in a jerk does; a new direction in each frame."""
    import cv2

    del index
    length, angle = int(rng.integers(12, 31)), rng.uniform(0.0, np.pi)
    kernel = np.zeros((31, 31), np.float32)
    reach = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    ends = [tuple(round(15 + sign * c) for c in reach) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], 1.0, 1)
    return np.asarray(cv2.filter2D(shot.grey, -1, kernel / kernel.sum()), np.uint8), shot.depth_m


def exposure_jumps(shot: Shot, index: int, rng: np.random.Generator) -> Images:
    """Let the gain jump between a third and the double, every fifth of a second."""
    gain = (1.0, 0.35, 2.0, 0.5, 1.6)[(index // 3 + int(rng.integers(0, 2))) % 5]
    return np.clip(gain * shot.grey.astype(np.float32), 0, 255).astype(np.uint8), shot.depth_m


def person(shot: Shot, index: int, rng: np.random.Generator) -> Images:
    """Somebody in patterned clothes walks by at 1.5 m: 0.5 m wide, from side to side in three seconds."""
    del rng
    height, width = shot.grey.shape
    cloth = np.kron(np.random.default_rng(17).integers(30, 226, (60, 26)), np.ones((8, 8))).astype(np.uint8)
    left = round(-170 + (width + 170) * index / 45.0)
    grey, depth_m = shot.grey.copy(), shot.depth_m.copy()
    u0, u1 = max(left, 0), min(left + 170, width)
    if u0 < u1:
        grey[60:, u0:u1] = cloth[: height - 60, u0 - left : u1 - left]
        depth_m[60:, u0:u1] = 1.5
    return grey, depth_m


def dead_pixels(shot: Shot, index: int, rng: np.random.Generator) -> Images:
    """Two per cent of the pixels are black or white, anew in each frame; ten per cent of the depth is gone or wild."""
    del index
    grey, depth_m = shot.grey.copy(), shot.depth_m.copy()
    bad = rng.random(grey.shape) < 0.02
    grey[bad] = np.where(rng.random(int(bad.sum())) < 0.5, 0, 255)
    bad = rng.random(depth_m.shape) < 0.1
    depth_m[bad] = np.where(rng.random(int(bad.sum())) < 0.8, 0.0, rng.uniform(0.5, 8.0, int(bad.sum())))
    return grey, depth_m


def low_texture(shot: Shot, index: int, rng: np.random.Generator) -> Images:
    """Fog or a bare wall: blurred by 2.5 pixels, a fifth of the contrast, the sensor's noise stays."""
    import cv2

    del index
    soft = cv2.GaussianBlur(shot.grey.astype(np.float32), (0, 0), 2.5)
    grey = 128.0 + 0.2 * (soft - 128.0) + rng.normal(0.0, 1.5, soft.shape)
    return np.clip(grey, 0, 255).astype(np.uint8), shot.depth_m


FAULTS: dict[str, Fault] = {
    "blackout of 2 s": Fault(30, blackout, back=True),
    "30 % of frames dropped, 4 s": Fault(60, dropped),
    "motion blur, 1 s": Fault(15, motion_blur),
    "exposure jumps, 2 s": Fault(30, exposure_jumps),
    "a person walks through, 3 s": Fault(45, person),
    "rain of dead pixels, 2 s": Fault(30, dead_pixels),
    "low texture, 2 s": Fault(30, low_texture),
}


@dataclass(frozen=True, slots=True)
class _Played:
    shots: list[Shot]
    begin: int
    """First frame of the fault, and first after it, among ``shots``."""
    end: int


def play(turn: Turn, fault: Fault, seed: int) -> _Played:
    """Return a case's frames with the fault in them; the same arguments give the same frames."""
    rng = np.random.default_rng([seed, 404])
    back = int(rng.integers(10, 23)) if fault.back else 0
    moment = int(rng.integers(MOMENTS[0], min(MOMENTS[1], len(turn) - AFTER - fault.frames)))
    shots = [turn.shot(k) for k in range(moment - BEFORE, moment)]
    for k in range(fault.frames):
        shot = turn.shot(moment + (0 if fault.back else k))
        images = fault.spoil(shot, k, rng)
        if images is not None:
            shots.append(replace(shot, grey=images[0], depth_m=images[1]))
    end = len(shots)
    after = moment - back if fault.back else moment + fault.frames
    shots += [turn.shot(after + k) for k in range(AFTER)]
    step_ns = round(1e9 / RATE_HZ)
    if fault.back:  # the frames are not in the order they were taken in
        shots = [replace(s, stamp_ns=turn.stamp_ns[0] + i * step_ns, accel_camera=None) for i, s in enumerate(shots)]
    return _Played(shots, BEFORE, end)


def run_case(turn: Turn, name: str, seed: int, config: SlamConfig) -> dict[str, Any]:
    """Run one case and return its row."""
    played = play(turn, FAULTS[name], seed)
    slam = Slam(turn.intrinsics, config)
    heard = listen(slam, iter(played.shots))
    before = [
        (T, s.T_map_camera)
        for h, s in _located(heard, played.shots, 0, played.begin)
        if (T := h.T_first_camera) is not None
    ]
    A = mean_alignment([m for m, _ in before], [t for _, t in before])

    def errors(begin: int, end: int) -> list[float]:
        rows = [(h.T_first_camera, s.T_map_camera) for h, s in _located(heard, played.shots, begin, end)]
        return [float(np.linalg.norm(pose_errors([m], [t], A)[0, :3])) for m, t in rows if m is not None]

    back = next((k for k in range(played.end, len(heard)) if heard[k].T_first_camera is not None), None)
    during, later = errors(played.begin, played.end), errors(played.end, len(heard))
    recovered_s = float("inf") if back is None else (back - played.end + 1) / RATE_HZ
    worst = max(later, default=float("inf"))
    return {
        "lost": sum(h.T_first_camera is None for h in heard[played.begin : played.end]),
        "recovered_s": round(recovered_s, 3) if np.isfinite(recovered_s) else None,
        "worst_during_m": round(max(during, default=0.0), 4),
        "worst_after_m": round(worst, 4) if np.isfinite(worst) else None,
        "lost_after": sum(h.T_first_camera is None for h in heard[played.end :]),
        "good": bool(recovered_s <= RECOVER_S and worst <= LIMIT_M),
        "resets": int(slam.reset_counter),
    }  # fmt: skip


def _located(heard: list[Heard], shots: list[Shot], begin: int, end: int) -> Iterator[tuple[Heard, Shot]]:
    """Yield the located frames of a stretch with their truth."""
    for k in range(begin, end):
        if heard[k].T_first_camera is not None:
            yield heard[k], shots[k]
