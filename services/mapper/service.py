"""The mapper as a service: keyframes and graphs in; submaps, an index of them and the ground out.

``map/cloud`` carries one submap per message. New or thinned points come with a new ``version``. A submap that the
graph merely moved is sent with its old version, its new pose and no points; ``removed`` withdraws a submap.
``map/index`` says what there is: whoever holds less or older asks ``map/cloud`` for it, or for the whole map.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from schemas.codec import Wire
from schemas.mapping import MapIndex, SubmapsWanted
from schemas.slam import Graph, Keyframe, Transform
from schemas.topics import MAP_CLOUD, MAP_GROUND, MAP_INDEX, MAP_SKETCH, SLAM_GRAPH, SLAM_KEYFRAME
from services.camera.codecs import FrameError, decode_colour_image, decode_depth
from services.common.context import Context
from services.common.geometry import from_transform, inverse
from services.common.state import state_folder
from services.mapper.cloud import KeyframeCloud, keyframe_cloud, pixel_rays
from services.mapper.config import MapperConfig
from services.mapper.dense_map import DenseMap, MapCloud, MapSubmap
from services.mapper.ground_model import GroundModel
from services.mapper.ground_patches import GroundPatches, Occasion
from services.mapper.keeper import MapKeeper
from services.mapper.local_submap import LocalSubmap
from services.mapper.saved_map import SavedMap, as_message, map_file
from services.mapper.sketch import sketch_of

Matrix = NDArray[np.float64]

_LOOK_S = 1.0
_INDEX_S = 5.0
"""Without any change the index is still told so often, for those who missed the last one."""
_FARTHEST_M = 5_000.0
"""From the map's origin: no aircraft was there, and the ground between would need a terabyte."""
_HOLD_S = 3.0
"""So long keyframes that the saved map knows wait for the graph that tells whether it is slam's map still."""
_SHARED = 3
"""Keyframes of the saved map that slam's graph must still have. Not a share of them: while the mapper was away slam has thinned its map,
and one keyframe holds the submaps of many that are gone."""


class MapperService:
    """Holds the dense map and tells of its changes."""

    def __init__(self, context: Context, config: MapperConfig) -> None:
        self._context = context
        self._config = config
        self.map = DenseMap(config)
        self._graph_version = 0
        self._nodes: dict[int, Transform] = {}
        self._poses: dict[int, Matrix] = {}
        """Of the latest graph."""
        self._rays: tuple[Intrinsics, NDArray[np.float32]] | None = None
        self._local = LocalSubmap(config)
        self._ground = GroundPatches(config.ground_cell_model_m)
        self._epoch = context.clock.now_ns()
        self._index_due_ns = 0
        self._news, self._unsaved = False, False
        folder = state_folder(config.state_dir, context.uav, os.environ, simulated=context.clock.simulated)
        file = None if folder is None else map_file(folder, context.uav)
        self._keeper = None if file is None else MapKeeper(file, context.health.count, context.health.note)
        self._saved: SavedMap | None = None if self._keeper is None else self._keeper.load()
        self._held_back: list[Keyframe] = []
        self._held_since_ns = 0
        self._waited = False
        """No graph came in time: keyframes wait no longer. The saved map still may."""
        context.on(SLAM_KEYFRAME, self.on_keyframe)
        context.on(SLAM_GRAPH, self.on_graph)
        context.every(_LOOK_S, self.on_timer)
        context.answer_state(MAP_CLOUD, self.whole_map, SubmapsWanted, self.wanted_submaps)
        context.answer_state(MAP_SKETCH, self.whole_sketch)
        context.answer_state(MAP_GROUND, lambda: list(self._ground.whole(self._occasion())))
        if self._keeper is not None:
            context.every_wall(config.save_s, self._save_now_and_then)
            context.on_stop(self._on_stop)

    def cloud(self) -> MapCloud:
        """Return the whole map in the map frame."""
        return self.map.cloud()

    @property
    def ground(self) -> GroundModel:
        """The ground per cell, as last looked at."""
        return self._ground.model

    def on_keyframe(self, keyframe: Keyframe) -> None:
        """Take up a keyframe, unless it is known or its images are damaged."""
        self._follow_map(keyframe.map_id)
        if self._astray((keyframe.T_map_camera,)):
            return
        if self._may_be_saved(keyframe):
            self._held_since_ns = self._held_since_ns if self._held_back else self._context.clock.now_ns()
            self._held_back.append(keyframe)
            return
        if keyframe.keyframe_id in self.map.submaps:
            self._context.health.count("repeated_keyframes")
            return
        if keyframe.graph_version < self._graph_version and keyframe.keyframe_id not in self._poses:
            self._context.health.count("culled_keyframes")  # it is told at the place that the graph has moved since
            return
        try:
            depth_m, rgb, rays = self._images(keyframe)
        except FrameError as error:
            self._context.health.count("bad_keyframes")
            self._context.health.note("slam/keyframe", f"keyframe {keyframe.keyframe_id} left out: {error}")
            return
        self._context.health.note("slam/keyframe", "")
        with self._context.health.timed("cloud"):
            cloud = keyframe_cloud(depth_m, rgb, rays, self._config)
        T = from_transform(keyframe.T_map_camera)
        if keyframe.graph_version < self._graph_version:
            T = self._poses[keyframe.keyframe_id]
        self._graph_version = max(self._graph_version, keyframe.graph_version)
        self._context.health.count("keyframes")
        self._tell(self._add(keyframe, depth_m, rays, cloud, T), points=True)

    def on_graph(self, graph: Graph) -> None:
        """Move the submaps to where the graph now puts their keyframes; an older graph is ignored."""
        self._follow_map(graph.map_id)
        if graph.version < self._graph_version or self._astray(node.T_map_camera for node in graph.nodes):
            return
        self._unsaved |= graph.version > self._graph_version  # a saved map of an older graph may be another slam's
        self._graph_version = graph.version
        self._poses = self._read_poses(graph)
        self._restore(self._poses)
        self._take_held_back()
        with self._context.health.timed("move"):
            moves = self.map.move(self._poses)
        self._tell(moves.moved, points=False)
        self._tell(moves.thinned, points=True)

    def on_timer(self) -> None:
        """Tell the ground that changed, and what the map holds."""
        if not self.map.map_id:
            return
        if self._held_back and self._context.clock.now_ns() - self._held_since_ns > _HOLD_S * 1e9:
            self._waited = True
            self._take_held_back()
        with self._context.health.timed("ground"):
            patches = self._ground.changes(self.map.submaps, self._occasion())
        for patch in patches:
            self._context.publish(MAP_GROUND, patch)
        now_ns = self._context.clock.now_ns()
        if not self._news and now_ns < self._index_due_ns:
            return
        self._news, self._index_due_ns = False, now_ns + round(_INDEX_S * 1e9)
        self._context.publish(MAP_INDEX, self.index())

    def index(self) -> MapIndex:
        """Return what the map holds."""
        held = [(s.submap_id, s.version, s.sent_graph) for s in self.map.submaps.values() if len(s.points_m)]
        ids, versions, placed_by = zip(*held, strict=True) if held else ((), (), ())
        return MapIndex(
            stamp_ns=self._context.clock.now_ns(), map_id=self.map.map_id, epoch=self._epoch,
            graph_version=self._graph_version, submap_ids=ids, versions=versions, placed_by=placed_by,
            ground_sequence=self._ground.sequence,
        )  # fmt: skip

    def whole_map(self) -> list[Wire]:
        """Return every submap with its points."""
        return self._with_points(self.map.submaps.values())

    def wanted_submaps(self, wanted: SubmapsWanted) -> list[Wire]:
        """Return the submaps that somebody misses; those of another map are not here."""
        submaps = self.map.submaps if wanted.map_id == self.map.map_id else {}
        return self._with_points(submaps[number] for number in wanted.submap_ids if number in submaps)

    def _with_points(self, submaps: Iterable[MapSubmap]) -> list[Wire]:
        version = self._graph_version
        return [as_message(s, self.map.map_id, version, points=True) for s in submaps if len(s.points_m)]

    def whole_sketch(self) -> list[Wire]:
        """Return every submap as the radio carries it."""
        return [sketch_of(s, self.map.map_id, points=True) for s in self.map.submaps.values() if len(s.points_m)]

    def _add(
        self,
        keyframe: Keyframe,
        depth_m: NDArray[np.float32],
        rays: NDArray[np.float32],
        cloud: KeyframeCloud,
        T: Matrix,
    ) -> list[MapSubmap]:
        """Enter a cloud, moved onto the local submap where that is wanted and does good."""
        health, number = self._context.health, keyframe.keyframe_id
        if not self._config.register_clouds:
            with health.timed("insert"):
                return self.map.add(number, keyframe.stamp_ns, cloud, T)
        with health.timed("register"):
            view = self._local.view(depth_m, rays, keyframe.intrinsics)
            result = self._local.register(view, T, self.map.submaps)
        health.count("registered" if result.accepted else "not_registered")
        with health.timed("insert"):
            changed = self.map.add(number, keyframe.stamp_ns, cloud, T, inverse(T) @ result.T_correction @ T)
        self._local.keep(number, view, self.map.submaps)
        return changed

    def _occasion(self) -> Occasion:
        return Occasion(self._context.clock.now_ns(), self.map.map_id, self._graph_version)

    def _read_poses(self, graph: Graph) -> dict[int, Matrix]:
        """Return the poses of a graph; those that did not change are not made again."""
        nodes = {node.keyframe_id: node.T_map_camera for node in graph.nodes}
        known = self._nodes
        poses = {
            k: self._poses[k] if k in self._poses and _same(known[k], T) else from_transform(T)
            for k, T in nodes.items()
        }
        self._nodes = nodes
        return poses

    def _astray(self, poses: Iterable[Transform]) -> bool:
        """Whether slam tells places where nobody can have been: left out, counted and told."""
        worst_m = max((abs(v) for pose in poses for v in pose.position_m), default=0.0)
        if worst_m <= _FARTHEST_M:
            self._context.health.note("slam", "")
            return False
        self._context.health.count("poses_astray")
        self._context.health.note(
            "slam", f"a keyframe {worst_m / 1000.0:.0f} km from the start: slam is astray; restart it"
        )
        return True

    def _follow_map(self, map_id: str) -> None:
        if map_id == self.map.map_id:
            return
        old = self.map.map_id
        gone = self.map.reset(map_id)
        self._graph_version, self._poses, self._nodes = 0, {}, {}
        self._local.clear()
        self._ground.model.clear()
        self._news = True
        self._held_back = []
        if self._saved is not None and self._saved.map_id != map_id:
            self._saved = None
        looked_at = self._context.listened(MAP_SKETCH)
        for submap in gone:
            self._context.publish(MAP_CLOUD, as_message(submap, old, 0, points=False, removed=True))
            if looked_at:
                self._context.publish(MAP_SKETCH, sketch_of(submap, old, points=False, removed=True))

    def _restore(self, poses: Mapping[int, Matrix]) -> None:
        """Take up the saved map when slam still works on it: the same name, a later graph, some of its keyframes still in it."""
        saved, self._saved = self._saved, None
        if saved is None or saved.map_id != self.map.map_id or saved.graph_version > self._graph_version:
            return
        anchors = {s.anchor_id for s in saved.submaps}
        if len(anchors & poses.keys()) < min(_SHARED, len(anchors)):
            self._context.health.count("saved_map_left")
            return
        back = [s for s in saved.submaps if s.submap_id not in self.map.submaps]
        self.map.restore(back)
        self._context.health.count("submaps_restored", len(back))
        self._tell(back, points=True)

    def _may_be_saved(self, keyframe: Keyframe) -> bool:
        """Return whether the saved map, not yet taken up or refused, has this keyframe."""
        saved = self._saved
        if saved is None or self._waited or saved.map_id != keyframe.map_id:
            return False
        return any(s.submap_id == keyframe.keyframe_id and s.stamp_ns == keyframe.stamp_ns for s in saved.submaps)

    def _take_held_back(self) -> None:
        waiting, self._held_back = self._held_back, []
        for keyframe in waiting:
            self.on_keyframe(keyframe)

    def _images(self, keyframe: Keyframe) -> tuple[NDArray[np.float32], NDArray[np.uint8] | None, NDArray[np.float32]]:
        i = keyframe.intrinsics
        if self._rays is None or self._rays[0] != i:
            self._rays = (i, pixel_rays(i))
        raw = decode_depth(keyframe.depth, keyframe.depth_encoding, i.width, i.height)
        depth_m = raw.astype(np.float32) * np.float32(1.0 / i.depth_scale)
        rgb = None
        if keyframe.colour_jpeg:
            bgr = decode_colour_image(keyframe.colour_jpeg, i.width, i.height)
            rgb = np.ascontiguousarray(bgr[:, :, ::-1])
        return depth_m, rgb, self._rays[1]

    def _tell(self, submaps: list[MapSubmap], *, points: bool) -> None:
        """Publish submaps that changed; one that lost its last point is withdrawn."""
        self._ground.model.touch(submaps)
        self._news |= bool(submaps)
        self._unsaved |= bool(submaps)
        looked_at = bool(submaps) and self._context.listened(MAP_SKETCH)
        for submap in submaps:
            if len(submap.points_m) == 0 and (not points or submap.version == 1):
                continue
            self._context.health.count("submaps_sent" if points else "submaps_moved")
            submap.sent_graph = self._graph_version
            removed = len(submap.points_m) == 0
            self._context.publish(
                MAP_CLOUD,
                as_message(submap, self.map.map_id, self._graph_version, points=points, removed=removed),
            )
            if looked_at:
                self._context.publish(MAP_SKETCH, sketch_of(submap, self.map.map_id, points=points, removed=removed))

    def _save(self) -> bool:
        assert self._keeper is not None
        self._keeper.look()
        if not self._unsaved or not self.map.submaps:
            return True
        begun = self._keeper.save(self.map.map_id, self._graph_version, list(self.map.submaps.values()))
        self._unsaved = not begun
        return begun

    def _save_now_and_then(self) -> None:
        self._save()

    def _on_stop(self) -> None:
        assert self._keeper is not None
        self._keeper.finish(self._save)


def _same(a: Transform, b: Transform) -> bool:
    return a.position_m == b.position_m and a.quaternion_xyzw == b.quaternion_xyzw


def build(context: Context) -> MapperService:
    """Warm the kernels and join the service to the bus."""
    from services.mapper.warm import warm

    warm()
    return MapperService(context, getattr(context.config, "mapper", MapperConfig()))
