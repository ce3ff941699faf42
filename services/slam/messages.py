"""slam's results as messages."""

from __future__ import annotations

import numpy as np

from schemas.camera import RgbdFrame
from schemas.slam import GraphNode, Pose, Transform
from services.common.geometry import to_transform
from services.slam.results import GraphUpdate, TrackResult


class Nodes:
    """Graph nodes as messages; those that did not move are not made again (500 keyframes: 9 ms, so 1 ms)."""

    def __init__(self) -> None:
        self._made: dict[int, tuple[bytes, GraphNode]] = {}

    def of(self, graph: GraphUpdate) -> tuple[GraphNode, ...]:
        """Return the nodes of a graph."""
        made: dict[int, tuple[bytes, GraphNode]] = {}
        for serial, T in graph.nodes:
            key, known = T.tobytes(), self._made.get(serial)
            same = known is not None and known[0] == key
            made[serial] = known if known is not None and same else (
                key, GraphNode(keyframe_id=serial, T_map_camera=to_transform(T))
            )  # fmt: skip
        self._made = made
        return tuple(node for _, node in made.values())


def pose_message(frame: RgbdFrame, result: TrackResult, map_id: str, processing_ms: float) -> Pose:
    """Return the message of one frame's result."""
    relative: Transform | None = None
    if result.T_keyframe_camera is not None:
        relative = to_transform(result.T_keyframe_camera)
    covariance = None
    if result.covariance is not None:
        covariance = tuple(float(c) for c in result.covariance[np.triu_indices(6)])
    return Pose(
        stamp_ns=frame.stamp_ns, seq=frame.seq, map_id=map_id, status=result.status,
        T_map_camera=None if result.T_map_camera is None else to_transform(result.T_map_camera),
        covariance=covariance, reset_counter=result.reset_counter, graph_version=result.graph_version,
        keyframe_id=result.keyframe_id, T_keyframe_camera=relative, inliers=result.inliers,
        up_sigma_rad=result.up_sigma_rad, processing_ms=processing_ms,
    )  # fmt: skip
