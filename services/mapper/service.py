"""The mapper as a service: keyframes and graphs in, submaps out.

``map/cloud`` carries one submap per message. New or thinned points come with a new ``version``. A submap that the
graph merely moved is sent with its old version, its new pose and no points; a consumer that does not hold that version
asks the key for the whole map. ``removed`` withdraws a submap.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from schemas.codec import Wire
from schemas.mapping import Submap
from schemas.slam import Graph, Keyframe
from schemas.topics import MAP_CLOUD, SLAM_GRAPH, SLAM_KEYFRAME
from services.camera.codecs import FrameError, decode_colour_image, decode_depth
from services.common.context import Context
from services.common.geometry import from_transform
from services.mapper.cloud import keyframe_cloud, pixel_rays
from services.mapper.config import MapperConfig
from services.mapper.dense_map import DenseMap, MapCloud, MapSubmap

Matrix = NDArray[np.float64]

_ORIGIN = np.zeros((1, 3), dtype=np.float32)
_NO_POINTS = np.zeros((0, 3), dtype=np.float32)
_NO_COLOUR = np.zeros((0, 3), dtype=np.uint8)


class MapperService:
    """Holds the dense map and tells of its changes."""

    def __init__(self, context: Context, config: MapperConfig) -> None:
        self._context = context
        self._config = config
        self.map = DenseMap(config)
        self._graph_version = 0
        self._poses: dict[int, Matrix] = {}
        """Of the latest graph."""
        self._rays: tuple[Intrinsics, NDArray[np.float32]] | None = None
        context.on(SLAM_KEYFRAME, self.on_keyframe)
        context.on(SLAM_GRAPH, self.on_graph)
        context.answer_state(MAP_CLOUD, self.whole_map)

    def cloud(self) -> MapCloud:
        """Return the whole map in the map frame."""
        return self.map.cloud()

    def on_keyframe(self, keyframe: Keyframe) -> None:
        """Take up a keyframe, unless it is known or its images are damaged."""
        self._follow_map(keyframe.map_id)
        if keyframe.keyframe_id in self.map.submaps:
            self._context.health.count("repeated_keyframes")
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
            T = self._poses.get(keyframe.keyframe_id, T)
        self._graph_version = max(self._graph_version, keyframe.graph_version)
        with self._context.health.timed("insert"):
            changed = self.map.add(keyframe.keyframe_id, keyframe.stamp_ns, cloud, T)
        self._context.health.count("keyframes")
        for submap in changed:
            self._publish(submap, points=True)

    def on_graph(self, graph: Graph) -> None:
        """Move the submaps to where the graph now puts their keyframes; an older graph is ignored."""
        self._follow_map(graph.map_id)
        if graph.version < self._graph_version:
            return
        self._graph_version = graph.version
        self._poses = {node.keyframe_id: from_transform(node.T_map_camera) for node in graph.nodes}
        with self._context.health.timed("move"):
            moves = self.map.move(self._poses)
        for submap in moves.moved:
            self._publish(submap, points=False)
        for submap in moves.thinned:
            self._publish(submap, points=True)

    def whole_map(self) -> list[Wire]:
        """Return every submap with its points."""
        return [self._message(s, points=True) for s in self.map.submaps.values()]

    def _follow_map(self, map_id: str) -> None:
        if map_id == self.map.map_id:
            return
        old = self.map.map_id
        gone = self.map.reset(map_id)
        self._graph_version, self._poses = 0, {}
        for submap in gone:
            self._context.publish(MAP_CLOUD, self._message(submap, points=False, map_id=old, removed=True))

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

    def _publish(self, submap: MapSubmap, *, points: bool) -> None:
        self._context.health.count("submaps_sent" if points else "submaps_moved")
        self._context.publish(MAP_CLOUD, self._message(submap, points=points))

    def _message(self, submap: MapSubmap, *, points: bool, map_id: str = "", removed: bool = False) -> Submap:
        n = len(submap.points_m) if points else 0
        return Submap(
            map_id=map_id or self.map.map_id, submap_id=submap.submap_id, version=submap.version,
            graph_version=self._graph_version, stamp_ns=submap.stamp_ns, T_map_submap=submap.T_map_submap.copy(),
            points_m=submap.points_m if points else _NO_POINTS, view=np.zeros(n, dtype=np.uint16), origins_m=_ORIGIN,
            colour=submap.rgb if points else _NO_COLOUR, removed=removed,
        )  # fmt: skip


def build(context: Context) -> MapperService:
    """Warm the kernels and join the service to the bus."""
    from services.mapper.warm import warm

    warm()
    return MapperService(context, getattr(context.config, "mapper", MapperConfig()))
