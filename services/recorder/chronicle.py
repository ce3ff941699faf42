"""Gathers a mission's story while it is recorded, and tells when its report is due. Pure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from schemas.codec import Wire
from schemas.health import Health
from schemas.mapping import Submap
from schemas.navigation import MissionState
from schemas.slam import Pose
from schemas.trees import Target, TreeList
from services.common.geometry import apply, from_transform
from services.evaluate.mission_report import Story, thinned

ENDS = frozenset({"landed", "released", "failed"})
_MOST_POSES, _MOST_TARGETS, _MOST_STATES = 40_000, 20_000, 2_000
_POINTS_A_SUBMAP = 4_000


class Chronicle:
    """Everything a report tells, bounded; begun anew with each mission."""

    def __init__(self, uav: str) -> None:
        self._uav = uav
        self._story = Story(uav=uav)
        self._clouds: dict[int, Submap] = {}
        """Thinned; of the points alone is made use."""

    @property
    def told(self) -> bool:
        """Whether any mission was heard of."""
        return any(state.state != "idle" for state in self._story.states)

    def hear(self, message: Wire) -> bool:
        """Take a message; return whether a mission has ended with it: its report is due."""
        story = self._story
        match message:
            case Pose():
                self._take_pose(message)
            case TreeList():
                story.trees = message.trees
            case Target():
                if message.status != "none" and len(story.targets) < _MOST_TARGETS:
                    story.targets.append(message)
            case Submap():
                self._take_submap(message)
            case Health():
                story.health[message.service] = message
            case MissionState():
                return self._take_state(message)
        return False

    def _take_pose(self, pose: Pose) -> None:
        story = self._story
        if pose.map_id != story.map_id:
            # what was said in another map has another origin
            story.map_id, story.trajectory, story.trees = pose.map_id, [], ()
            self._clouds.clear()
        if pose.T_map_camera is not None and len(story.trajectory) < _MOST_POSES:
            story.trajectory.append((pose.stamp_ns, from_transform(pose.T_map_camera)))

    def _take_submap(self, submap: Submap) -> None:
        now = submap.after(self._clouds.get(submap.submap_id))
        if now is None:
            self._clouds.pop(submap.submap_id, None)
            return
        step = max(1, len(now.points_m) // _POINTS_A_SUBMAP)
        self._clouds[submap.submap_id] = replace(now, points_m=now.points_m[::step])

    def _take_state(self, state: MissionState) -> bool:
        story = self._story
        last = story.states[-1] if story.states else None
        if last is not None and last.state in ENDS and state.state not in ENDS:
            # another mission in the same map: its path is its own, and those of a whole day would be too many
            story.states, story.targets, story.trajectory, last = [], [], [], None
        if last is not None and (last.state, last.reason) == (state.state, state.reason):
            return False
        if len(story.states) < _MOST_STATES:
            story.states.append(state)
        return state.state in ENDS and (last is None or last.state not in ENDS)

    def story(self) -> Story:
        """Return what a report is made from."""
        story = self._story
        clouds = [apply(s.T_map_submap, s.points_m.astype(np.float64)) for _, s in sorted(self._clouds.items())]
        story.points_m = np.concatenate(clouds).astype(np.float32) if clouds else np.empty((0, 3), np.float32)
        return Story(
            story.uav, story.map_id, thinned(story.trajectory), story.trees, story.targets, story.states, story.health,
            story.points_m,
        )  # fmt: skip
