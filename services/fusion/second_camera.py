"""The second camera as a process: the camera service with the second camera's source and keys."""

from __future__ import annotations

from schemas.topics import CAMERA_COMPRESSED, CAMERA_RGBD, SECOND_RGBD, SIM_RGBD, SIM_SECOND
from services.camera.service import CameraService
from services.camera.service import build as build_camera
from services.common.context import Context
from services.fusion.renamed import RenamedContext, require_second


def build(context: Context) -> CameraService:
    """Start the camera service on ``fusion.second.camera``.

    Raises:
        InputError: there is no second camera, or its source cannot be opened.
    """
    require_second(context.config)
    config = context.config.model_copy(update={"camera": context.config.fusion.second.camera})
    names = {CAMERA_RGBD: SECOND_RGBD, CAMERA_COMPRESSED: None, SIM_RGBD: SIM_SECOND}
    return build_camera(RenamedContext(context, config, names))
