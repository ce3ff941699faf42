"""What slam says: the pose of every frame, keyframes with depth, and the graph that places them."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from schemas.camera import Intrinsics
from schemas.envelope import Counter, Message, Name, Part, Quaternion, StampNs, Vec3

SlamStatus = Literal["initialising", "tracking", "lost", "relocalising", "dead_reckoned"]
"""``dead_reckoned`` comes from fusion alone: the pose is carried on without the first camera, for holding still by only."""
GraphReason = Literal["keyframe", "local_ba", "loop", "full_ba", "relocalised", "restored"]


class Transform(Part):
    """Rigid transform ``T_a_b``: takes points of frame b to frame a."""

    position_m: Vec3
    quaternion_xyzw: Quaternion

    @field_validator("quaternion_xyzw")
    @classmethod
    def _unit(cls, value: Quaternion) -> Quaternion:
        norm = math.sqrt(sum(c * c for c in value))
        if abs(norm - 1.0) > 1e-6:
            raise ValueError(f"quaternion of norm {norm:.9f}, expected 1 within 1e-6")
        return value


class Pose(Message):
    """The camera's pose at one frame. Without a trustworthy pose ``T_map_camera`` is absent: never a guess.

    Only with the status ``dead_reckoned`` it is one that no first camera stands behind; its covariance says how good it is.
    """

    SCHEMA: ClassVar[str] = "treedock.pose"

    stamp_ns: StampNs
    seq: Counter
    map_id: Name
    status: SlamStatus
    T_map_camera: Transform | None
    covariance: Annotated[tuple[float, ...], Field(min_length=21, max_length=21)] | None
    """Upper triangle, row by row, of the 6x6 covariance of (x, y, z, rx, ry, rz): metres and radians, both in
    the map frame, for a left perturbation ``exp(r) R``."""
    reset_counter: Annotated[int, Field(ge=0, le=255)]
    """Up by one (mod 256) whenever the pose jumps by correction: loop closure, relocalisation."""
    graph_version: Counter
    keyframe_id: Counter | None
    """The keyframe this pose is relative to, and ``T_keyframe_camera`` the relative pose: consumers that keep
    them follow later corrections of the graph."""
    T_keyframe_camera: Transform | None
    inliers: Annotated[int, Field(ge=0)]
    up_sigma_rad: Annotated[float, Field(ge=0.0, le=math.pi)]
    """Standard deviation of the map's vertical against gravity."""
    processing_ms: Annotated[float, Field(ge=0.0)]


class Keyframe(Message):
    """A keyframe with its compressed depth: all that mapper and detector need, on any machine."""

    SCHEMA: ClassVar[str] = "treedock.keyframe"
    MAX_BYTES: ClassVar[int] = 4 * 1024 * 1024

    keyframe_id: Counter
    stamp_ns: StampNs
    map_id: Name
    graph_version: Counter
    T_map_camera: Transform
    intrinsics: Intrinsics
    depth_encoding: Literal["png", "zstd"]
    depth: bytes
    colour_jpeg: bytes = b""


class GraphNode(Part):
    """Where one keyframe stands now."""

    keyframe_id: Counter
    T_map_camera: Transform


class Graph(Message):
    """All keyframes still in the map and their present poses; replaces every earlier version."""

    SCHEMA: ClassVar[str] = "treedock.graph"
    MAX_BYTES: ClassVar[int] = 4 * 1024 * 1024

    stamp_ns: StampNs
    map_id: Name
    version: Counter
    reset_counter: Annotated[int, Field(ge=0, le=255)]
    reason: GraphReason
    nodes: Annotated[tuple[GraphNode, ...], Field(max_length=20_000)]
    up_sigma_rad: Annotated[float, Field(ge=0.0, le=math.pi)]
