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
from services.common.geometry import Matrix, apply, from_transform
from services.common.rows import Rows
from services.evaluate.exports import Stamped
from services.evaluate.mission_report import Story, far_apart
from services.evaluate.sightings import SIGHTING, sighting

ENDS = frozenset({"landed", "released", "failed"})
_MOST_POSES, _MOST_TARGETS, _MOST_STATES = 40_000, 20_000, 2_000
_POINTS_A_SUBMAP = 4_000
_STAMPED = np.dtype([("stamp_ns", np.int64), ("T", np.float64, (4, 4))])


class Chronicle:
    """Everything a report tells, bounded; begun anew with each mission."""

    def __init__(self, uav: str) -> None:
        self._uav = uav
        self._story = Story(uav=uav)
        self._path = Path()
        self._seen = Rows(SIGHTING, _MOST_TARGETS)
        self._clouds: dict[int, Submap] = {}
        """Thinned; of the points alone is made use."""
        self.reported = False
        """Whether this mission's report was written; who writes it says so."""

    @property
    def owed(self) -> bool:
        """Whether a mission was heard of whose report was not written."""
        return not self.reported and any(state.state != "idle" for state in self._story.states)

    def hear(self, message: Wire) -> bool:
        """Take a message; return whether a mission has ended with it: its report is due."""
        story = self._story
        match message:
            case Pose():
                self._take_pose(message)
            case TreeList():
                story.trees = message.trees
            case Target():
                if message.status != "none":
                    self._seen.append(sighting(message))
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
            story.map_id, story.trees = pose.map_id, ()
            self._path.clear()
            self._clouds.clear()
        if pose.T_map_camera is not None:
            self._path.add(pose.stamp_ns, from_transform(pose.T_map_camera))

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
            story.states, last, self.reported = [], None, False
            self._seen.clear()
            self._path.clear()
        if last is not None and (last.state, last.reason) == (state.state, state.reason):
            return False
        if len(story.states) >= _MOST_STATES:
            story.states.pop()  # the newest takes its place: how a mission ended is known however much it told
        story.states.append(state)
        return state.state in ENDS and (last is None or last.state not in ENDS)

    def story(self) -> Story:
        """Return what a report is made from."""
        story = self._story
        clouds = [apply(s.T_map_submap, s.points_m.astype(np.float64)) for _, s in sorted(self._clouds.items())]
        story.points_m = np.concatenate(clouds).astype(np.float32) if clouds else np.empty((0, 3), np.float32)
        return Story(
            story.uav, story.map_id, self._path.poses(), story.trees, self._seen.values, story.states, story.health,
            story.points_m,
        )  # fmt: skip


class Path:
    """Where the camera was, as close as a picture needs it; the first and the last pose are always there."""

    def __init__(self) -> None:
        self._kept = Rows(_STAMPED, _MOST_POSES)
        self._last: Stamped | None = None

    def add(self, stamp_ns: int, T_map_camera: Matrix) -> None:
        """Take a pose (4, 4)."""
        self._last = (stamp_ns, T_map_camera)
        if not len(self._kept) or far_apart(self._kept.last["T"], T_map_camera):
            self._kept.append(self._last)

    def clear(self) -> None:
        """Begin anew."""
        self._kept.clear()
        self._last = None

    def poses(self) -> list[Stamped]:
        """Return the poses in the order of their coming."""
        kept = [(int(row["stamp_ns"]), row["T"]) for row in self._kept.values]
        if self._last is not None and kept[-1][0] != self._last[0]:
            kept.append(self._last)
        return kept
