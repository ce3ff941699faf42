"""The detector as a service: submaps in, the list of trees out, with ids that stay."""

from __future__ import annotations

import logging
import os

from schemas.codec import Wire
from schemas.mapping import MapIndex, Submap, SubmapsWanted
from schemas.topics import MAP_CLOUD, MAP_INDEX, SLAM_POSE, TREES_LIST, TREES_TARGET
from schemas.trees import Target, Tree, TreeList
from services.common.context import Context
from services.common.state import state_folder
from services.detector.config import DetectorServiceConfig
from services.detector.fusion import Fusion
from services.detector.identity import Identities
from services.detector.incremental import Incremental
from services.detector.map_store import MapStore
from services.detector.model import DetectionResult
from services.detector.names import NamesKeeper, SavedNames, TakingUp, saved_trees
from services.detector.report import as_tree

LOG = logging.getLogger(__name__)

_ASK_TIMEOUT_S = 2.0
_ASKED_AT_ONCE = 32
"""Submaps of one question: few enough (some MB) to be answered in time on a machine that has much else to do."""
_VERSIONS_LOST = 1000
"""More lists than a run can have sent after it last wrote their number."""
_QUIET_S = 2.0
"""When the map did not change for so long there is time to look at the whole of it."""


class DetectorService:
    """Keeps the map, detects when it changed, publishes what changed in the list."""

    def __init__(self, context: Context, config: DetectorServiceConfig) -> None:
        self._context = context
        self._config = config
        self._store = MapStore()
        self._identities = Identities(config)
        self._fusion = Fusion(config.fusion)
        self._refined = False
        """Whether the refiner has said something since the last list."""
        folder = state_folder(config.state_dir, context.uav, os.environ, simulated=context.clock.simulated)
        health = context.health
        self._keeper = None if folder is None else NamesKeeper(folder, context.uav, health.count, health.note)
        self._saved = None if self._keeper is None else self._keeper.load()
        """What the run before kept, until the first word of a map."""
        self._taking_up: TakingUp | None = None
        self._whole = True
        """Whether the map has been whole since known trees waited for it."""
        self._incomplete = False
        self._asking = False
        self._graph_version = 0
        """Of the map at the last detection."""
        self._version = 0
        if self._saved is not None:
            self._identities.next_id = self._saved.next_id
            self._version = self._saved.list_version + _VERSIONS_LOST
        self._published: TreeList | None = None
        self._incremental = Incremental(config.slicing)
        self._quiet = 0
        """Timers since the map changed last."""
        context.on(MAP_CLOUD, self.on_submap)
        context.on(MAP_INDEX, self.on_index)
        context.on(SLAM_POSE, self._fusion.on_pose)
        context.on(TREES_TARGET, self.on_target)
        context.every(1.0 / config.max_rate_hz, self.on_timer)
        context.answer_state(TREES_LIST, self.state)
        context.on_stop(lambda: self._keep_names(at_once=True))

    def on_submap(self, submap: Submap) -> None:
        """Take up a change of the map."""
        if submap.map_id != self._store.map_id:
            if submap.removed:
                return
            self._begin(submap.map_id)
        if not self._store.take(submap):
            self._incomplete = True

    def on_index(self, index: MapIndex) -> None:
        """Notice what of the map was missed; a late joiner begins with it."""
        if not self._store.map_id:
            self._begin(index.map_id)
        epoch, now_ns = self._store.epoch, self._context.clock.now_ns()
        if self._store.lacks(index, now_ns):
            self._incomplete = True
        if epoch not in (None, self._store.epoch) and self._taking_up is None and self._identities.trees:
            self._taking_up = TakingUp(self._graph_version, now_ns, saved=False)  # the mapper was started again

    def on_target(self, target: Target) -> None:
        """Take up what the refiner measured."""
        if self._fusion.on_target(target):
            self._context.health.count("refined_frames")
            self._refined = True

    def on_timer(self) -> None:
        """Detect when the map changed since the last time; else tell of what the refiner found since."""
        if self._incomplete and not self._asking:
            self._ask_for_missing()
        if not self._taken_up():
            return
        self._quiet = 0 if self._store.changed_points > 0 else self._quiet + 1
        if self._store.changed_points > 0:
            self._detect()
            self._publish()
        elif self._incremental.partial and self._quiet >= _QUIET_S * self._config.max_rate_hz:
            self._detect(whole=True)
            self._publish()
        elif self._refined and self._published is not None:
            age_s = (self._context.clock.now_ns() - self._published.stamp_ns) * 1e-9
            if age_s >= self._config.fusion.publish_every_s:
                self._publish()

    def final_trees(self) -> list[Tree]:
        """Return the trees of the map as it is now; those that the last look at it did not confirm are left out."""
        if self._store.changed_points > 0 or self._incremental.partial:
            self._detect(whole=True)
        return self._trees(confirmed=True)

    def state(self) -> list[Wire]:
        """Return the latest list, if there is one."""
        return [self._published] if self._published is not None else []

    def _begin(self, map_id: str) -> None:
        """Forget the old map."""
        self._store.clear(map_id)
        self._identities.clear()
        self._incremental.clear()
        self._fusion.clear(map_id)
        saved, self._saved, self._taking_up, self._whole = self._saved, None, None, True
        if saved is not None and saved.map_id == map_id and saved.trees:
            self._identities.take_up(saved.tracked())
            self._taking_up = TakingUp(saved.graph_version, self._context.clock.now_ns(), saved=True)
            self._context.health.count("trees_taken_up", len(saved.trees))
            self._incomplete = True

    def _taken_up(self) -> bool:
        """Return whether no known trees wait for their map any more."""
        if self._taking_up is not None:
            now_ns, patience_s = self._context.clock.now_ns(), self._config.await_map_s
            if not self._taking_up.over(self._identities, self._store, now_ns, patience_s):
                return False
            self._taking_up, self._whole = None, False
        return True

    def _ask_for_missing(self) -> None:
        """Ask for some of what is missing; nobody waits for the answer."""
        missing = self._store.missing()[:_ASKED_AT_ONCE]
        self._incomplete, self._asking = False, bool(missing)
        if missing:
            wanted = SubmapsWanted(map_id=self._store.map_id, submap_ids=tuple(missing))
            self._context.health.count("map_queries")
            self._context.ask_later(MAP_CLOUD, wanted, Submap, _ASK_TIMEOUT_S, self._on_missing)

    def _on_missing(self, replies: list[Submap]) -> None:
        """Take up what was missing, and go on asking while that helps; else the next index asks again, ever more seldom."""
        self._asking = False
        before = len(self._store.missing())
        for submap in replies:
            if submap.map_id == self._store.map_id and len(submap.points_m) > 0:
                self._store.take(submap)
        left = len(self._store.missing())
        if left < before:
            self._store.was_helped()
        self._incomplete = self._incomplete or 0 < left < before

    @property
    def result(self) -> DetectionResult | None:
        """The last detection, for explanations."""
        return self._incremental.result

    def _detect(self, *, whole: bool = False) -> None:
        health = self._context.health
        self._identities.follow(self._store.poses())
        with health.timed("assemble"):
            points, views = self._store.assemble()
        touched = self._store.settle()
        with health.timed("detect"):
            if whole:
                result = self._incremental.whole(points, views)
            else:
                result = self._incremental.update(points, views, touched)
        self._whole = self._whole or self._store.complete
        for event in self._identities.update(result.trunks, lambda place: self._whole and self._store.shows(place)):
            health.count(f"trees_{event.kind}")
            LOG.info("%s", event)
        self._identities.fasten(self._store.poses())
        self._graph_version = self._store.graph_version
        health.count("partial_detections" if self._incremental.partial else "detections")

    def _trees(self, *, confirmed: bool) -> list[Tree]:
        kept = [t for t in self._identities.trees if t.missed == 0 or not confirmed]
        keyframes = self._store.poses()
        return [
            self._fusion.corrected(as_tree(t.trunk, t.tree_id, t.observations), keyframes)
            for t in sorted(kept, key=lambda t: t.tree_id)
        ]

    def _publish(self) -> None:
        self._refined = False
        trees = tuple(self._trees(confirmed=False))
        last = self._published
        if last is not None and last.map_id == self._store.map_id and not self._news(last.trees, trees):
            return
        self._version += 1
        self._published = TreeList(
            stamp_ns=self._context.clock.now_ns(), map_id=self._store.map_id, version=self._version,
            graph_version=self._store.graph_version, trees=trees,
        )  # fmt: skip
        self._keep_names()  # before anybody hears of them
        self._context.publish(TREES_LIST, self._published)

    def _keep_names(self, *, at_once: bool = False) -> None:
        """Keep what the next run has to know, unless this one has not taken up the last one's yet."""
        if self._keeper is None or self._published is None or self._taking_up is not None:
            return
        ids, map_id, now_ns = self._identities, self._store.map_id, self._context.clock.now_ns()
        if not at_once and not self._keeper.due(map_id, ids.trees, now_ns):
            return
        names = SavedNames(
            map_id=map_id, graph_version=self._graph_version, list_version=self._version, next_id=ids.next_id,
            trees=saved_trees(ids.trees),
        )  # fmt: skip
        self._keeper.keep(names, now_ns)

    def _news(self, old: tuple[Tree, ...], new: tuple[Tree, ...]) -> bool:
        if [t.id for t in old] != [t.id for t in new]:
            return True
        limit = self._config.publish_move_m
        return any(
            abs(a.x_m - b.x_m) > limit or abs(a.y_m - b.y_m) > limit or abs(a.radius_m - b.radius_m) > limit
            or a.suitable != b.suitable or abs(a.confidence - b.confidence) > 0.02
            for a, b in zip(old, new, strict=True)
        )  # fmt: skip


def build(context: Context) -> DetectorService:
    """Warm the kernels and join the service to the bus."""
    from services.detector.warm import warm

    warm()
    return DetectorService(context, context.config.detector)
