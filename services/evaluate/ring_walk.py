"""A synthetic walk through an endless plantation, for the mapper's memory and time: exact depth images, no rendering."""

from __future__ import annotations

import importlib
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from schemas.slam import Graph, GraphNode, Keyframe, Transform
from schemas.topics import SLAM_GRAPH, SLAM_KEYFRAME
from services.camera.codecs import encode_depth
from services.common.config import TreedockConfig
from services.common.geometry import level_camera, to_transform
from services.common.memory import Hub

Floats = NDArray[np.float64]

STEP_M = 0.5
"""Between keyframes."""
ROW_M = 30.0
"""The walk goes to and fro over rows of this length, BETWEEN_M apart."""
BETWEEN_M = 5.0
_PLANT_M = 3.0
_RADIUS_M = 0.12
_FAR_M = 6.0
CAMERA = Intrinsics(width=320, height=240, fx=250.0, fy=250.0, cx=159.5, cy=119.5, depth_scale=1000.0)


@dataclass(frozen=True, slots=True)
class WalkResult:
    """What the mapper needed over a walk."""

    keyframes: int
    area_m2: float
    """Of the cells with points in them."""
    points: int
    nbytes: int
    keyframe_ms: Floats
    """CPU time of all that the mapper did for each keyframe and its graph, ground and index included."""


def pose_at(step: int) -> Floats:
    """Return ``T_map_camera`` of a keyframe: level, along the rows, half a turn between two of them."""
    per_row = round(ROW_M / STEP_M)
    row, along = divmod(step, per_row)
    back = row % 2 == 1
    x = ROW_M - along * STEP_M if back else along * STEP_M
    return level_camera([x, row * BETWEEN_M, 1.5], np.pi if back else 0.0)


def depth_at(T_map_camera: Floats, noise: np.random.Generator) -> NDArray[np.uint16]:
    """Return the depth image (H, W), millimetres, of the plantation: flat ground, upright trunks on a square grid."""
    i = CAMERA
    u, v = np.meshgrid(np.arange(i.width, dtype=np.float64), np.arange(i.height, dtype=np.float64))
    rays = np.stack([(u - i.cx) / i.fx, (v - i.cy) / i.fy, np.ones_like(u)], axis=2) @ T_map_camera[:3, :3].T
    at = T_map_camera[:3, 3]
    depth = np.where(rays[..., 2] < -1e-6, -at[2] / np.minimum(rays[..., 2], -1e-6), np.inf)
    columns = rays[0, :, :2]  # a level camera: one column of pixels looks in one direction of the plan
    near = np.floor(at[:2] / _PLANT_M)
    for dx in range(-2, 4):
        for dy in range(-2, 4):
            tree = (near + (dx, dy) + 0.5) * _PLANT_M
            depth = np.minimum(depth, _to_trunk(columns, tree - at[:2])[None, :])
    depth = depth + noise.normal(0.0, 1.0, depth.shape) * 0.001 * np.minimum(depth, 10.0) ** 2
    return np.where(depth < _FAR_M, np.round(1000.0 * depth), 0.0).astype(np.uint16)


def _to_trunk(columns: Floats, away: Floats) -> Floats:
    a = np.einsum("ij,ij->i", columns, columns)
    b = columns @ away
    inside = b * b - a * (float(away @ away) - _RADIUS_M**2)
    return np.where((inside > 0) & (b > 0), (b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)


def walk(keyframes: int, *, rounds: int = 1, max_points: int = 40_000_000, seed: int = 0) -> WalkResult:
    """Send a walk of so many keyframes, ``rounds`` times over the same ground, with a graph of all after each keyframe."""
    config = TreedockConfig()
    config = config.model_copy(update={"mapper": config.mapper.model_copy(update={"max_points": max_points})})
    hub = Hub(config)
    mapper = importlib.import_module("services.mapper.service").build(hub.context("mapper"))
    slam = hub.context("slam")
    noise = np.random.default_rng(seed)
    nodes: list[GraphNode] = []
    spent = np.zeros(keyframes * rounds)
    for number in range(keyframes * rounds):
        T = pose_at(number % keyframes)
        placed = to_transform(T)
        nodes.append(GraphNode(keyframe_id=number, T_map_camera=placed))
        messages = _messages(number, placed, encode_depth(depth_at(T, noise), "zstd"), nodes)
        begin = time.process_time()
        slam.publish(SLAM_KEYFRAME, messages[0])
        slam.publish(SLAM_GRAPH, messages[1])
        hub.run()
        hub.advance_to(number * 1_000_000_000)
        spent[number] = 1e3 * (time.process_time() - begin)
    cells = len(mapper.ground.covered)
    return WalkResult(
        keyframes * rounds, cells * mapper.ground.cell_m**2, mapper.map.size, mapper.map.nbytes, spent
    )  # fmt: skip


def _messages(number: int, placed: Transform, depth: bytes, nodes: list[GraphNode]) -> tuple[Keyframe, Graph]:
    keyframe = Keyframe(
        keyframe_id=number, stamp_ns=number, map_id="walk", graph_version=number + 1, T_map_camera=placed,
        intrinsics=CAMERA, depth_encoding="zstd", depth=depth,
    )  # fmt: skip
    graph = Graph(
        stamp_ns=number, map_id="walk", version=number + 1, reset_counter=0, reason="keyframe", nodes=tuple(nodes),
        up_sigma_rad=0.0,
    )  # fmt: skip
    return keyframe, graph
