"""Writes small ROS bags of the made-up frames, as ROS 1 and as ROS 2."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from services.camera.codecs import encode_colour, encode_depth
from tests.camera_data import CAMERA, colour_image, depth_image, stamp_ns

COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/color/camera_info"
DEPTH_LATE_NS = 7_000_000


class BagMaker:
    """Messages of one ROS version."""

    def __init__(self, ros: int) -> None:
        self.ros = ros
        self.store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)

    def header(self, stamp: int) -> Any:
        types = self.store.types
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        more = {"seq": 0} if self.ros == 1 else {}
        return types["std_msgs/msg/Header"](stamp=time, frame_id="camera_color_optical_frame", **more)

    def image(self, stamp: int, pixels: np.ndarray, encoding: str, padding: int = 0) -> Any:
        rows = np.ascontiguousarray(pixels).reshape(pixels.shape[0], -1).view(np.uint8)
        rows = np.pad(rows, ((0, 0), (0, padding)))
        return self.store.types["sensor_msgs/msg/Image"](
            header=self.header(stamp), height=pixels.shape[0], width=pixels.shape[1], encoding=encoding,
            is_bigendian=0, step=rows.shape[1], data=rows.reshape(-1),
        )  # fmt: skip

    def compressed(self, stamp: int, data: bytes, form: str) -> Any:
        return self.store.types["sensor_msgs/msg/CompressedImage"](
            header=self.header(stamp), format=form, data=np.frombuffer(data, np.uint8)
        )

    def info(self, stamp: int, D: tuple[float, ...] = (), model: str = "plumb_bob") -> Any:
        types = self.store.types
        roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        fx, fy, cx, cy = (float(CAMERA[name]) for name in ("fx", "fy", "cx", "cy"))
        K = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0])
        P = np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0])
        names = ("D", "K", "R", "P") if self.ros == 1 else ("d", "k", "r", "p")
        values = dict(zip(names, (np.array(D), K, np.eye(3).ravel(), P), strict=True))
        return types["sensor_msgs/msg/CameraInfo"](
            header=self.header(stamp), height=32, width=48, distortion_model=model, binning_x=0, binning_y=0, roi=roi,
            **values,
        )  # fmt: skip

    def write(self, path: Path, messages: list[tuple[str, int, Any]], *, mcap: bool = False) -> Path:
        """Write (topic, time, message) in the order given; returns the path to open."""
        if self.ros == 1:
            writer: Any = Writer1(path)
        else:
            writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
        with writer:
            connections: dict[str, Any] = {}
            for topic, stamp, message in messages:
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                pack = self.store.serialize_ros1 if self.ros == 1 else self.store.serialize_cdr
                writer.write(connections[topic], stamp, bytes(pack(message, kind)))
        return path


def depth_mm(index: int) -> np.ndarray:
    """Return (32, 48) millimetres."""
    return (depth_image(index) // 5).astype(np.uint16)


def camera_messages(maker: BagMaker, count: int, form: str = "raw") -> list[tuple[str, int, Any]]:
    """Return what a camera driver records: ``raw``, ``compressed`` or ``float``."""
    out: list[tuple[str, int, Any]] = [(INFO, stamp_ns(0), maker.info(stamp_ns(0), (0.1, -0.2, 0.001, 0.002, 0.05)))]
    for k in range(count):
        at, late = stamp_ns(k), stamp_ns(k) + DEPTH_LATE_NS
        if form == "compressed":
            jpeg = encode_colour(colour_image(k), "jpeg", 95)
            out.append((COLOUR + "/compressed", at, maker.compressed(at, jpeg, "rgb8; jpeg compressed bgr8")))
            png = bytes(12) + encode_depth(depth_mm(k), "png")
            out.append((DEPTH + "/compressedDepth", late, maker.compressed(late, png, "16UC1; compressedDepth png")))
            continue
        rgb = cv2.cvtColor(colour_image(k), cv2.COLOR_BGR2RGB)
        out.append((COLOUR, at, maker.image(at, rgb, "rgb8", padding=8)))
        if form == "float":
            metres = np.where(depth_mm(k) > 0, depth_mm(k) / 1000.0, np.nan).astype(np.float32)
            out.append((DEPTH, late, maker.image(late, metres, "32FC1")))
        else:
            out.append((DEPTH, late, maker.image(late, depth_mm(k), "16UC1")))
    return out
