"""Small services for the process tests, run as real processes: ``python -m tests.process.nodes ROLE PORT``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from schemas.camera import Intrinsics, RgbdFrame
from schemas.slam import Keyframe, Transform
from schemas.topics import CAMERA_RGBD, SLAM_KEYFRAME, SLAM_POSE, TREES_LIST
from schemas.trees import Tree, TreeList
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.errors import InputError
from services.common.runtime import run_service
from services.common.stop import end_process
from services.router.config import RouterConfig
from services.router.service import run as run_router

INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5)
KEYFRAMES = 20


def frame(seq: int) -> RgbdFrame:
    colour = bytes([seq % 251]) * (640 * 480 * 3)
    depth = bytes([seq % 241]) * (640 * 480 * 2)
    return RgbdFrame(stamp_ns=time.time_ns(), seq=seq, intrinsics=INTRINSICS, colour=colour, depth=depth)


def tree_list(version: int) -> TreeList:
    tree = Tree(
        id=7, x_m=1.0, y_m=2.0, z_m=0.0, axis=(0.0, 0.0, 1.0), radius_m=0.12, radius_height_m=1.3, height_seen_m=2.0,
        sigma_xy_m=0.01, sigma_radius_m=0.005, arc_rad=2.0, confidence=0.9, observations=5, suitable=True,
    )  # fmt: skip
    return TreeList(stamp_ns=1, map_id="m", version=version, graph_version=0, trees=(tree,))


def keyframe(number: int) -> Keyframe:
    return Keyframe(
        keyframe_id=number, stamp_ns=number, map_id="m", graph_version=0,
        T_map_camera=Transform(position_m=(0.0, 0.0, 0.0), quaternion_xyzw=(0.0, 0.0, 0.0, 1.0)),
        intrinsics=INTRINSICS, depth_encoding="png", depth=bytes(50_000),
    )  # fmt: skip


def camera(context: Context) -> None:
    sent = 0

    def send() -> None:
        nonlocal sent
        context.publish(CAMERA_RGBD, frame(sent))
        context.health.count("frames")
        sent += 1

    context.every(0.05, send)


def slam(context: Context) -> None:
    """Counts whole frames; any torn one would be counted as wrong."""

    def look(got: RgbdFrame) -> None:
        right = bytes(got.colour) == bytes([got.seq % 251]) * len(got.colour) and got.depth[-1] == got.seq % 241
        context.health.count("whole" if right else "wrong")

    context.on(CAMERA_RGBD, look)


def detector(context: Context) -> None:
    """Says what it has to say once, at its start."""
    context.publish(TREES_LIST, tree_list(3))
    for number in range(KEYFRAMES):
        context.publish(SLAM_KEYFRAME, keyframe(number))
    context.answer_state(TREES_LIST, lambda: [tree_list(1), tree_list(2), tree_list(3)])


def refuser(context: Context) -> None:
    def refuse(_: object) -> None:
        raise InputError("this is not for me")

    context.on(SLAM_POSE, refuse)
    context.on(TREES_LIST, lambda _: context.health.count("lists"))


def crasher(context: Context) -> None:
    def fall() -> None:
        raise RuntimeError("on purpose")

    context.every(0.3, fall)


def hanger(context: Context) -> None:
    context.every(0.3, lambda: time.sleep(60.0))


def ticker(context: Context) -> None:
    """Lives by simulated time."""
    context.every(1.0, lambda: context.health.count("ticks"))
    context.every_wall(0.2, lambda: context.health.count("wall_ticks"))


ROLES: dict[str, Callable[[Context], None]] = {
    "camera": camera, "slam": slam, "detector": detector, "refuser": refuser, "crasher": crasher, "hanger": hanger,
    "ticker": ticker,
}  # fmt: skip


def main(role: str, port: int) -> int:
    config = TreedockConfig(router=RouterConfig(port=port), clock="sim" if role == "ticker" else "wall")
    if role == "router":
        return run_router(config)
    return run_service(role, ROLES[role], config)


if __name__ == "__main__":
    end_process(main(sys.argv[1], int(sys.argv[2])))
