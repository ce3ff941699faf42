"""Keeping the map small: keyframes go whose points others see as well; where one stood is remembered."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.common.geometry import inverse, pose
from services.slam.atlas import Atlas, neighbours
from services.slam.links import remove_keyframe
from services.slam.tidy import redundancy
from services.slam.tracking import moved
from services.slam.worker import Crew

F64 = NDArray[np.float64]

_REDUNDANT = 0.9
_BEHIND, _REDUNDANT_BEHIND = 100, 0.6
"""A keyframe goes whose points three others see to such a share; and to this, once so many younger ones live."""
_CLOSE_M, _CLOSE_RAD, _REDUNDANT_CLOSE = 0.6, 0.25, 0.3
"""And to this, when those before and after it stand so close together."""


class Thinning:
    """Takes keyframes out of the map that it does not need."""

    def __init__(self, atlas: Atlas, crew: Crew) -> None:
        self.atlas = atlas
        self.step = crew.step
        self.retired: dict[int, tuple[int, F64]] = {}
        """Culled keyframes: serial -> (serial of its stand-in, T_standin_keyframe)."""

    def cull_about(self, k: int) -> None:
        """Look at the keyframes that see what the new one ``k`` sees."""
        atlas = self.atlas
        with self.step():
            near = neighbours(atlas, k, 15, 30)
        for other in near:
            with self.step():
                kf = atlas.keyframes
                if kf.serial[other] == 0 or kf.serial[other] >= kf.serial[k] - 1:
                    continue
                if redundancy(atlas.points, kf, int(other)) > _REDUNDANT:
                    self.retire(int(other))

    def cull_behind(self) -> None:
        """Look once at each keyframe when it has fallen far behind: there a thinner map will do."""
        with self.step():
            slots = self.atlas.slots
            if len(slots) <= _BEHIND + 1:
                return
            before, old, after = (int(s) for s in slots[-_BEHIND - 1 : -_BEHIND + 2])
            kf = self.atlas.keyframes
            distance_m, angle_rad = moved(kf.R[before], kf.t[before], kf.R[after], kf.t[after])
            close = distance_m < _CLOSE_M and angle_rad < _CLOSE_RAD
            enough = _REDUNDANT_CLOSE if close else _REDUNDANT_BEHIND
            if kf.serial[old] and redundancy(self.atlas.points, kf, old) > enough:
                self.retire(old)

    def retire(self, k: int) -> None:
        """Take a keyframe out of the map, remembering where it stood relative to its nearest relative."""
        atlas = self.atlas
        kf = atlas.keyframes
        standin = neighbours(atlas, k, 1, 1)
        if not len(standin):
            return
        s = int(standin[0])
        relative = pose(kf.R[s], kf.t[s]) @ inverse(pose(kf.R[k], kf.t[k]))
        self.retired[int(kf.serial[k])] = (int(kf.serial[s]), relative)
        remove_keyframe(atlas.points, kf, k)

    def pose_of(self, serial: int) -> F64:
        """Return T_map_keyframe (4, 4) of a keyframe that lives, or lived.

        Raises:
            KeyError: for a serial that never was.
        """
        relative = np.eye(4)
        while serial in self.retired:
            serial, step = self.retired[serial]
            relative = step @ relative
        k = self.atlas.slot_of(serial)
        if k < 0:
            raise KeyError(f"no keyframe {serial}")
        return inverse(pose(self.atlas.keyframes.R[k], self.atlas.keyframes.t[k])) @ relative
