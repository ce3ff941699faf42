"""Every tracked frame relative to its keyframe: the trajectory that later corrections of the map still move."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(slots=True)
class Trail:
    """Grows by a frame; left empty in a live service, which would grow without end."""

    stamp_ns: list[int] = field(default_factory=list)
    keyframe: list[int] = field(default_factory=list)
    T_keyframe_camera: list[F64] = field(default_factory=list)

    def add(self, stamp_ns: int, keyframe: int, T_keyframe_camera: F64) -> None:
        """Remember a frame."""
        self.stamp_ns.append(stamp_ns)
        self.keyframe.append(keyframe)
        self.T_keyframe_camera.append(T_keyframe_camera)

    def placed(self, keyframe_pose: Callable[[int], F64]) -> list[tuple[int, F64]]:
        """Return (stamp_ns, T_map_camera) of each frame; ``keyframe_pose(id)`` is T_map_keyframe as now known."""
        rows = zip(self.stamp_ns, self.keyframe, self.T_keyframe_camera, strict=True)
        return [(stamp, keyframe_pose(serial) @ T) for stamp, serial, T in rows]
