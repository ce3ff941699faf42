"""Keeps to the target: under another id when the list changes, and where the depth image has it. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from schemas.trees import Target
from services.common.geometry import Matrix
from services.navigator.docking import DockSample
from services.navigator.selection import SAME_TREE_M, axis_at
from services.navigator.track import Sample

if TYPE_CHECKING:
    from services.navigator.board import Board

_AXIS_TIME_CONSTANT_S = 0.4
_AXIS_GATE_M = 0.6
JUMPED_M = 0.5
"""A listed tree that far from the target's believed axis is another tree: corrections move both alike."""


@dataclass
class Following:
    """What following the target has to remember from step to step."""

    list_version: int = -1
    off_gate: bool = False
    """The depth image shows a trunk where the map has none: not our target, whatever its id."""
    astray: str = ""
    """Why the target's id names another tree now; empty when it does not."""
    astray_again: bool = False
    """It was so before, in the same list: choosing anew would change nothing."""
    _astray_at: tuple[int, int] | None = None
    """Id and version of the list when it last was."""
    _stamp_ns: int = -1

    def list_changed(self, b: Board) -> None:
        """Keep to the target when the list changes: under another id, and, until it is seen, at another place.

        A place far from where the target is believed is another tree's: it is never followed there. Where no other id
        is at the target's place either, ``astray`` says so.
        """
        seen = b.inputs.trees
        if seen is None or b.axis_m is None or seen.message.version == self.list_version:
            return
        self.list_version, self.astray = seen.message.version, ""
        z, axis = b.flight_z_m, b.axis_m
        named = next((t for t in b.trees if t.id == b.target_id), None)
        off_m = 0.0 if named is None else float(np.linalg.norm(axis_at(named, z) - axis))
        if named is None or off_m > JUMPED_M:
            near = [(float(np.linalg.norm(axis_at(t, z) - axis)), t.id, t) for t in b.trees if t.suitable]
            distance, _, at_place = min(near, default=(float("inf"), 0, None))
            if at_place is None or distance > SAME_TREE_M:
                if named is not None:
                    self._went_astray(named.id, f"the list has tree {named.id} {off_m:.1f} m from where it was")
                return
            named, b.target_id = at_place, at_place.id
        if b.target_seen_ns is None:
            b.axis_m, b.ground_z_m = axis_at(named, z), named.z_m

    def _went_astray(self, tree_id: int, why: str) -> None:
        at = (tree_id, self.list_version)
        self.astray, self.astray_again, self._astray_at = why, at == self._astray_at, at

    def target_seen(self, b: Board) -> None:
        """Take the target's sight of this step, unless it cannot be our trunk."""
        self.off_gate = False
        t, here = b.target, b.here
        if t is None or here is None:
            return
        assert b.inputs.target is not None
        arrived_ns = b.inputs.target.received_ns
        if not t.measured:
            b.target_seen_ns = arrived_ns
            return
        if t.range_m is None or t.bearing_rad is None:
            return
        seen = _axis_seen(t, here)
        self.off_gate = b.axis_m is None or float(np.linalg.norm(seen - b.axis_m)) > _AXIS_GATE_M
        if self.off_gate or b.axis_m is None or t.stamp_ns <= self._stamp_ns:
            return
        b.target_seen_ns = arrived_ns
        dt = min((t.stamp_ns - self._stamp_ns) / 1e9, 1.0)
        self._stamp_ns = t.stamp_ns
        b.axis_m = b.axis_m + dt / (dt + _AXIS_TIME_CONSTANT_S) * (seen - b.axis_m)
        b.dock.add(DockSample(t.stamp_ns, t.range_m, t.bearing_rad, here.position_m.copy()))


def _axis_seen(t: Target, here: Sample) -> Matrix:
    if t.position_map_m is not None:
        return np.array(t.position_map_m)
    assert t.range_m is not None
    assert t.bearing_rad is not None
    heading = here.yaw_rad + t.bearing_rad
    return here.position_m[:2] + t.range_m * np.array([np.cos(heading), np.sin(heading)])
