"""Sound examples to damage, made once: clouds, images, recordings, maps, lists, configuration, MAVLink frames."""

from __future__ import annotations

import io
import json
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
from pymavlink.dialects.v20 import common as mav

from services.camera.codecs import encode_colour, encode_depth
from services.camera.sources.mcap_file import FrameWriter
from services.common.config import TreedockConfig
from services.common.config_loader import to_toml
from services.detector.identity import TrackedTree
from services.detector.map_store import Anchor
from services.detector.names import SavedNames, saved_trees
from services.evaluate.exports import ply_bytes
from services.mapper.saved_map import pack
from services.security.register import Issued, Register
from services.slam.store import BEAT, HEADER, KEYFRAME, encode_keyframe, record
from tests.camera_data import CAMERA, colour_image, depth_image, frame
from tests.ros_bags import BagMaker, camera_messages
from tests.unit.test_detector_identity import trunk_at
from tests.unit.test_mapper_saved import saved
from tests.unit.test_slam_store import keyframe

POINTS = np.random.default_rng(3).normal(0.0, 2.0, (40, 3)).round(3).astype(np.float32)


def ply() -> bytes:
    return ply_bytes(POINTS, np.zeros((len(POINTS), 3), np.uint8))


def pcd() -> bytes:
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 40\nHEIGHT 1\n"
        "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA binary\n"
    )
    return head.encode() + POINTS.tobytes()


def pcd_text() -> bytes:
    return pcd().split(b"DATA")[0] + b"DATA ascii\n" + xyz()


def xyz() -> bytes:
    return "".join(f"{x} {y} {z}\n" for x, y, z in POINTS).encode()


@cache
def las(*, compressed: bool) -> bytes:
    file = laspy.create(point_format=0, file_version="1.2")
    file.header.scales = (0.001, 0.001, 0.001)
    file.x, file.y, file.z = POINTS.T.astype(np.float64)
    out = io.BytesIO()
    file.write(out, do_compress=compressed)
    return out.getvalue()


def images() -> tuple[bytes, ...]:
    return bytes(encode_colour(colour_image(1), "jpeg")), cv2.imencode(".png", colour_image(1))[1].tobytes()


def depths() -> tuple[bytes, ...]:
    return bytes(encode_depth(depth_image(1), "png")), bytes(encode_depth(depth_image(1), "zstd"))


@cache
def mcap() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        with FrameWriter(path) as writer:
            for seq in range(3):
                writer.add(frame(seq, 10**9 + seq * 10**8))
        return path.read_bytes()


@cache
def ros_bag() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        maker = BagMaker(1)
        return maker.write(Path(folder) / "a.bag", camera_messages(maker, 2)).read_bytes()


def slam_log() -> bytes:
    parts = [record(HEADER, b'{"a": 1}'), *(record(KEYFRAME, encode_keyframe(keyframe(k))) for k in range(2))]
    return b"".join([*parts, record(BEAT, b"8" * 8)])


def mapper_map() -> bytes:
    return b"".join(pack(saved(2)))


def tree_ids() -> bytes:
    """The JSON alone, without its checksum."""
    trees = [TrackedTree(k, trunk_at(2.0, 0.5 * k), 3, 0, Anchor(k, np.eye(4))) for k in (1, 2)]
    names = SavedNames(map_id="m", graph_version=3, list_version=4, next_id=3, trees=saved_trees(trees))
    return names.model_dump_json().encode()


@cache
def certificates() -> bytes:
    entries = tuple(
        Issued(f"uav1.{r}.1", f"uav1.{r}", "ab", "2026-01-01T00:00:00Z", "2027-01-01T00:00:00Z")
        for r in ("slam", "camera")
    )
    with tempfile.TemporaryDirectory() as folder:
        Register(entries).write(Path(folder))
        return (Path(folder) / Register.FILE).read_bytes()


def toml() -> bytes:
    return to_toml(TreedockConfig().model_dump(mode="json"), {}).encode()


def json_config() -> bytes:
    return TreedockConfig().model_dump_json().encode()


def camera_json() -> bytes:
    return json.dumps({**CAMERA, "T_body_camera": np.eye(4).tolist()}).encode()


def tum_list() -> bytes:
    return b"# colour\n1305031102.000000 rgb/a.png\n1305031102.066666 rgb/b.png\n"


def accelerometer() -> bytes:
    return "".join(f"13050311{k:02d}.5 0.1 9.8 -0.5\n" for k in range(20)).encode()


def page_requests() -> tuple[bytes, ...]:
    order = {"t": "order", "id": 3, "uav": "uav1", "name": "choose", "tree_id": 4, "seen": 7}
    hello = {"t": "hello", "secret": "0123456789abcdef", "name": "Alice"}
    return json.dumps(order).encode(), json.dumps(hello).encode()


def mavlink_messages() -> list[Any]:
    """Return what an autopilot says, one of each that the bridge listens to, and a few that it does not."""
    return [
        mav.MAVLink_heartbeat_message(2, 12, 81, 4 << 16, 3, 3),
        mav.MAVLink_attitude_quaternion_message(1000, 1.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0),
        mav.MAVLink_local_position_ned_message(1000, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0),
        mav.MAVLink_extended_sys_state_message(0, 1),
        mav.MAVLink_sys_status_message(0, 0, 0, 500, 12000, 100, 80, 0, 0, 0, 0, 0, 0),
        mav.MAVLink_estimator_status_message(1000, 831, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1),
        mav.MAVLink_command_ack_message(176, 0),
        mav.MAVLink_param_value_message(b"EKF2_EV_CTRL", 1.5e-44, 6, 10, 0),
        mav.MAVLink_timesync_message(123, 456),
        mav.MAVLink_statustext_message(4, b"Preflight Fail: x"),
        mav.MAVLink_position_target_local_ned_message(1000, 1, 0, 1.0, 2.0, -3.0, 0, 0, 0, 0, 0, 0, 0.5, 0),
        mav.MAVLink_battery_status_message(0, 0, 0, 300, [4000] * 10, 500, 10, 10, 80),
    ]
