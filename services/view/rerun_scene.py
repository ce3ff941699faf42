"""Our messages as rerun's entities: frames of the scene are ``map`` and ``map/camera``; time is the message's stamp."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame
from schemas.codec import Wire
from schemas.mapping import Submap
from schemas.navigation import MissionState
from schemas.slam import Keyframe, Pose
from schemas.trees import Target, TreeList
from services.common.errors import InputError
from services.common.geometry import quaternion_from_rotation, rotation_aligning

if TYPE_CHECKING:
    from types import ModuleType

_GREEN, _OCHRE, _BLUE = (40, 170, 60), (205, 140, 30), (50, 110, 240)
_SHOWN_TRUNK_M = 2.5
_TIMELINE = "stamp"


def load_rerun() -> ModuleType:
    """Return the viewer's library.

    Raises:
        InputError: it is not installed.
    """
    try:
        import rerun
    except ImportError:
        raise InputError("the rerun viewer is not installed: pip install rerun-sdk") from None
    module: ModuleType = rerun
    return module


class Scene:
    """Logs messages into one rerun recording."""

    def __init__(self, rerun: ModuleType, recording: Any) -> None:  # noqa: ANN401 - the library is optional
        self._rr = rerun
        self._recording = recording
        self._intrinsics: Intrinsics | None = None
        self._map_id = ""
        self._mission = ""
        self.shown = 0
        rerun.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True, recording=recording)

    def show(self, message: Wire) -> None:
        """Log one message; those without a picture are passed over."""
        stamp_ns = getattr(message, "stamp_ns", None)
        if not isinstance(stamp_ns, int):
            return
        self._rr.set_time(_TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"), recording=self._recording)
        match message:
            case RgbdFrame():
                self._frame(message)
            case Keyframe():
                self._lens(message.intrinsics)
            case Pose():
                self._pose(message)
            case Submap():
                self._submap(message)
            case TreeList():
                self._trees(message)
            case Target():
                self._target(message)
            case MissionState():
                self._say(message)
            case _:
                return
        self.shown += 1

    def _log(self, entity: str, what: Any) -> None:  # noqa: ANN401 - rerun's archetypes
        self._rr.log(entity, what, recording=self._recording)

    def _lens(self, intrinsics: Intrinsics) -> None:
        if intrinsics == self._intrinsics:
            return
        i = self._intrinsics = intrinsics
        lens = self._rr.Pinhole(
            focal_length=(i.fx, i.fy), principal_point=(i.cx, i.cy), width=i.width, height=i.height,
            camera_xyz=self._rr.ViewCoordinates.RDF, image_plane_distance=0.4,
        )  # fmt: skip
        self._log("map/camera", lens)

    def _frame(self, frame: RgbdFrame) -> None:
        self._lens(frame.intrinsics)
        if frame.colour_encoding == "jpeg":
            self._log("map/camera/image", self._rr.EncodedImage(contents=bytes(frame.colour), media_type="image/jpeg"))
        elif frame.colour_encoding == "bgr8":
            shape = (frame.intrinsics.height, frame.intrinsics.width, 3)
            bgr = np.frombuffer(frame.colour, np.uint8).reshape(shape)
            self._log("map/camera/image", self._rr.Image(bgr, color_model="BGR").compress(jpeg_quality=80))

    def _pose(self, pose: Pose) -> None:
        if pose.map_id != self._map_id:
            # another map: what was shown of the old one stands elsewhere
            self._rr.log("map/cloud", self._rr.Clear(recursive=True), recording=self._recording)
            self._map_id = pose.map_id
        if pose.T_map_camera is not None:
            at, turn = pose.T_map_camera.position_m, pose.T_map_camera.quaternion_xyzw
            self._log("map/camera", self._rr.Transform3D(translation=at, quaternion=turn))
        else:
            self._log("log", self._rr.TextLog(f"slam: {pose.status}", level="WARN"))

    def _submap(self, submap: Submap) -> None:
        entity = f"map/cloud/{submap.submap_id}"
        if submap.removed:
            self._log(entity, self._rr.Clear(recursive=False))
            return
        T = submap.T_map_submap
        self._log(entity, self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        if not len(submap.points_m):
            return  # the graph moved it: its points stay as they are, in a frame that has moved
        colours = submap.colour if len(submap.colour) else None
        self._log(entity, self._rr.Points3D(submap.points_m, colors=colours, radii=0.006))

    def _trees(self, trees: TreeList) -> None:
        axes = np.array([t.axis for t in trees.trees]).reshape(-1, 3)
        heights = np.array([max(t.height_seen_m, _SHOWN_TRUNK_M) for t in trees.trees])
        feet = np.array([(t.x_m, t.y_m, t.z_m) for t in trees.trees]).reshape(-1, 3)
        up = np.array([0.0, 0.0, 1.0])
        trunks = self._rr.Cylinders3D(
            lengths=heights, radii=[t.radius_m for t in trees.trees], centers=feet + 0.5 * heights[:, None] * axes,
            quaternions=[self._rr.Quaternion(xyzw=quaternion_from_rotation(rotation_aligning(up, a))) for a in axes],
            colors=[_GREEN if t.suitable else _OCHRE for t in trees.trees],
            labels=[f"{t.id}: {200.0 * t.radius_m:.1f} cm" for t in trees.trees],
        )  # fmt: skip
        self._log("map/trees", trunks)

    def _target(self, target: Target) -> None:
        for name, value in (
            ("range_m", target.range_m),
            ("radius_m", target.radius_m),
            ("image_x_px", target.image_x_px),
        ):
            if value is not None:
                self._log(f"target/{name}", self._rr.Scalars(value))

    def _say(self, mission: MissionState) -> None:
        text = f"{mission.state}: {mission.reason}"
        if text != self._mission:
            self._mission = text
            self._log("log", self._rr.TextLog(text, level="WARN" if mission.failsafe else "INFO"))
