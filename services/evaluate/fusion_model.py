"""What slam would have told of a flown way, by a model of its errors: for many seeds, where rendering would take hours.

Drift is a random walk with the way in heading and place and a scale error, frames err by themselves; lost frames are given.
After a gap slam finds its place again a few frames late, with a new reset counter and a correction of some centimetres.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from services.common.geometry import Matrix, exp_rotation, pose, rotation_z
from services.evaluate.fusion_flight import Frame
from services.fusion.values import Located

_FRAME_M, _FRAME_RAD = 0.005, 0.0015
_BACK_FRAMES = 3
_BACK_M = 0.02


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """Drift per square root of a metre, and the scale's error as a share of the way."""

    shift_m: float = 0.04
    turn_rad: float = math.radians(0.15)
    scale: float = 0.01


def located_by_model(
    frames: tuple[Frame, ...],
    T_body_camera: Matrix,
    lost: Callable[[int], bool],
    seed: int,
    config: ModelConfig | None = None,
) -> list[Located | None]:
    """Return what slam tells of each frame; the map is the world, drifting. ``lost(index)`` frames have no pose."""
    c = config or ModelConfig()
    rng = np.random.default_rng([seed, 606])
    scale = 1.0 + c.scale * float(rng.standard_normal())
    told_m, turned, resets, blind = frames[0].T_world_body[:3, 3].copy(), 0.0, 0, 0
    offset = np.zeros(3)
    before = frames[0].T_world_body[:3, 3]
    sigma = np.repeat([2.0 * _FRAME_M, 2.0 * _FRAME_RAD], 3)
    out: list[Located | None] = []
    for k, frame in enumerate(frames):
        here = frame.T_world_body[:3, 3]
        way = math.sqrt(float(np.linalg.norm(here - before)))
        seen = not lost(k)
        if seen:
            turned += c.turn_rad * way * float(rng.standard_normal())
            told_m += c.shift_m * way * rng.standard_normal(3) * (1.0, 1.0, 0.3)
        told_m += scale * (rotation_z(turned) @ (here - before))
        before = here
        blind = (
            0
            if seen and blind == 0
            else (blind + 1 if not seen else -min(blind, _BACK_FRAMES) if blind > 0 else blind + 1)
        )
        if not seen or blind < 0:
            out.append(None)
            continue
        if out and out[-1] is None:
            resets += 1
            offset = _BACK_M * rng.standard_normal(3)
        R = exp_rotation(_FRAME_RAD * rng.standard_normal(3)) @ rotation_z(turned) @ frame.T_world_body[:3, :3]
        T = pose(R, told_m + offset + _FRAME_M * rng.standard_normal(3)) @ T_body_camera
        out.append(Located(frame.stamp_ns, T, np.diag(sigma**2), ("model", resets)))
    return out
