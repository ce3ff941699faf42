"""Our messages under Foxglove's schemas: image, calibration, transform, path of poses, cloud, scene and log.

Frames: ``map`` and ``camera``, as in our own messages; units are the same (metres, radians).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from schemas.camera import RgbdFrame
from schemas.codec import Wire
from schemas.mapping import Submap
from schemas.navigation import MissionState
from schemas.slam import Pose
from schemas.trees import Target, Tree, TreeList
from services.common.geometry import apply, quaternion_from_rotation, rotation_aligning

if TYPE_CHECKING:
    from google.protobuf.message import Message as ProtobufMessage

Channels = list[tuple[str, "ProtobufMessage"]]

_GREEN, _OCHRE, _BLUE = (0.1, 0.6, 0.2, 0.8), (0.8, 0.55, 0.1, 0.8), (0.1, 0.4, 1.0, 0.9)
_SHOWN_TRUNK_M = 2.5
_CLOUD_POINTS = 100_000
_CLOUD_PERIOD_NS = 5_000_000_000


def warm() -> None:
    """Import Foxglove's classes: the first message must not wait for that."""
    import importlib

    for name in ("CameraCalibration", "CompressedImage", "FrameTransform", "Log", "PackedElementField", "PointCloud",
                 "PoseInFrame", "SceneEntityDeletion", "SceneUpdate"):  # fmt: skip
        importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2")
    importlib.import_module("mcap_protobuf.schema")
    importlib.import_module("zstandard")


class Translator:
    """Turns messages into Foxglove's; holds the image rate and the map shown."""

    def __init__(self, prefix: str, image_hz: float) -> None:
        self._prefix = prefix
        self._image_period_ns = round(1e9 / image_hz)
        self._next_image_ns = 0
        self._cloud = _Cloud()

    def translate(self, message: Wire) -> Channels:
        """Return the channels and messages that ``message`` is shown as; none for what Foxglove has no panel for."""
        match message:
            case RgbdFrame():
                found = self._frame(message)
            case Pose():
                found = _pose(message)
            case Submap():
                found = self._cloud.shown(message)
            case TreeList():
                found = _trees(message)
            case Target():
                found = _target(message)
            case MissionState():
                found = _log(message)
            case _:
                found = []
        return [(f"/{self._prefix}/{name}", shown) for name, shown in found]

    def _frame(self, frame: RgbdFrame) -> Channels:
        if frame.colour_encoding != "jpeg" or frame.stamp_ns < self._next_image_ns:
            return []
        from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

        self._next_image_ns = frame.stamp_ns + self._image_period_ns
        i = frame.intrinsics
        image = CompressedImage(frame_id="camera", format="jpeg", data=bytes(frame.colour))
        calibration = CameraCalibration(
            frame_id="camera", width=i.width, height=i.height, distortion_model="plumb_bob",
            D=[i.k1, i.k2, i.p1, i.p2, i.k3], K=[i.fx, 0, i.cx, 0, i.fy, i.cy, 0, 0, 1], R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
            P=[i.fx, 0, i.cx, 0, 0, i.fy, i.cy, 0, 0, 0, 1, 0],
        )  # fmt: skip
        for shown in (image, calibration):
            _stamp(shown.timestamp, frame.stamp_ns)
        return [("image", image), ("calibration", calibration)]


def _pose(pose: Pose) -> Channels:
    if pose.T_map_camera is None:
        return []
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

    transform = FrameTransform(parent_frame_id="map", child_frame_id="camera")
    shown = PoseInFrame(frame_id="map")
    for at, place, turn in ((transform, transform.translation, transform.rotation),
                            (shown, shown.pose.position, shown.pose.orientation)):  # fmt: skip
        _stamp(at.timestamp, pose.stamp_ns)
        _place(place, pose.T_map_camera.position_m)
        _turn(turn, pose.T_map_camera.quaternion_xyzw)
    return [("transform", transform), ("pose", shown)]


class _Cloud:
    """The whole map in one channel, thinned, at most every few seconds: a channel shows its newest message only."""

    def __init__(self) -> None:
        self._submaps: dict[int, Submap] = {}
        self._next_ns = 0
        self._map_id = ""

    def shown(self, submap: Submap) -> Channels:
        if submap.map_id != self._map_id:
            self._submaps.clear()
            self._map_id = submap.map_id
        now = submap.after(self._submaps.get(submap.submap_id))
        if now is None:
            self._submaps.pop(submap.submap_id, None)
        else:
            self._submaps[submap.submap_id] = now
        if submap.stamp_ns < self._next_ns or not self._submaps:
            return []
        self._next_ns = submap.stamp_ns + _CLOUD_PERIOD_NS
        return [("cloud", self._message(submap.stamp_ns))]

    def _message(self, stamp_ns: int) -> ProtobufMessage:
        from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
        from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

        step = max(1, math.ceil(sum(len(s.points_m) for s in self._submaps.values()) / _CLOUD_POINTS))
        parts = [_placed(submap, step) for _, submap in sorted(self._submaps.items())]
        kinds = PackedElementField.NumericType
        fields = [PackedElementField(name=n, offset=4 * k, type=kinds.FLOAT32) for k, n in enumerate("xyz")]
        colours = enumerate(("red", "green", "blue", "alpha"))
        fields += [PackedElementField(name=n, offset=12 + k, type=kinds.UINT8) for k, n in colours]
        cloud = PointCloud(frame_id="map", point_stride=16, fields=fields, data=np.concatenate(parts).tobytes())
        cloud.pose.orientation.w = 1.0
        _stamp(cloud.timestamp, stamp_ns)
        return cloud


def _placed(submap: Submap, step: int) -> NDArray[np.void]:
    points = submap.points_m[::step]
    table = np.zeros(len(points), dtype=[("xyz", "<f4", 3), ("rgba", "u1", 4)])
    table["xyz"] = apply(submap.T_map_submap, points.astype(np.float64))
    table["rgba"][:, :3] = submap.colour[::step] if len(submap.colour) else 128
    table["rgba"][:, 3] = 255
    return table


def _trees(trees: TreeList) -> Channels:
    from foxglove_schemas_protobuf.SceneEntityDeletion_pb2 import SceneEntityDeletion
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    update = SceneUpdate()
    gone = update.deletions.add(type=SceneEntityDeletion.Type.ALL)
    _stamp(gone.timestamp, trees.stamp_ns)
    for tree in trees.trees:
        _add_trunk(update, tree, trees.stamp_ns)
    return [("trees", update)]


def _add_trunk(update: Any, tree: Tree, stamp_ns: int) -> None:
    entity = update.entities.add(frame_id="map", id=f"tree-{tree.id}")
    _stamp(entity.timestamp, stamp_ns)
    height_m = max(tree.height_seen_m, _SHOWN_TRUNK_M)
    axis = np.array(tree.axis)
    middle = np.array([tree.x_m, tree.y_m, tree.z_m]) + 0.5 * height_m * axis
    trunk = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
    _place(trunk.pose.position, middle)
    _turn(trunk.pose.orientation, quaternion_from_rotation(rotation_aligning(np.array([0.0, 0.0, 1.0]), axis)))
    _place(trunk.size, (2 * tree.radius_m, 2 * tree.radius_m, height_m))
    _colour(trunk.color, _GREEN if tree.suitable else _OCHRE)
    words = entity.texts.add(
        billboard=True,
        font_size=0.15,
        text=f"{tree.id}: {200 * tree.radius_m:.1f} cm" + " (not suitable)" * (not tree.suitable),
    )
    _place(words.pose.position, np.array([tree.x_m, tree.y_m, tree.z_m]) + (height_m + 0.2) * axis)
    words.pose.orientation.w = 1.0
    _colour(words.color, (1.0, 1.0, 1.0, 1.0))


def _target(target: Target) -> Channels:
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    if target.position_map_m is None or target.radius_m is None:
        return []
    update = SceneUpdate()
    entity = update.entities.add(frame_id="map", id="target")
    _stamp(entity.timestamp, target.stamp_ns)
    entity.lifetime.nanos = 500_000_000
    ring = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
    _place(ring.pose.position, (*target.position_map_m, 0.0))
    ring.pose.orientation.w = 1.0
    _place(ring.size, (2 * target.radius_m + 0.04, 2 * target.radius_m + 0.04, 0.1))
    _colour(ring.color, _BLUE)
    return [("target", update)]


def _log(mission: MissionState) -> Channels:
    from foxglove_schemas_protobuf.Log_pb2 import Log

    level = Log.Level.WARNING if mission.failsafe else Log.Level.INFO
    text = f"{mission.state}: {mission.reason}" + (f" [{mission.failsafe}]" if mission.failsafe else "")
    log = Log(level=level, message=text, name="mission")
    _stamp(log.timestamp, mission.stamp_ns)
    return [("mission", log)]


def _stamp(field: Any, stamp_ns: int) -> None:
    field.seconds, field.nanos = divmod(stamp_ns, 1_000_000_000)


def _place(field: Any, values: Any) -> None:
    field.x, field.y, field.z = (float(v) for v in values)


def _turn(field: Any, quaternion_xyzw: Any) -> None:
    values = [float(v) for v in quaternion_xyzw]
    assert math.isclose(math.hypot(*values), 1.0, abs_tol=1e-5)
    field.x, field.y, field.z, field.w = values


def _colour(field: Any, rgba: tuple[float, float, float, float]) -> None:
    field.r, field.g, field.b, field.a = rgba
