"""A camera for the stub aircraft: the simulator's renderer and the product's own preview, for the film strip."""

from __future__ import annotations

import cv2

from schemas.navigation import Guidance, MissionState
from schemas.preview import PreviewImage
from schemas.slam import Pose
from schemas.trees import Target, Tree
from services.common.geometry import from_transform
from services.preview.config import PreviewConfig
from services.preview.draw import Encoder, draw, scaled
from services.preview.overlay import overlay_of
from services.simulator.render import DEFAULT_INTRINSICS, Renderer
from services.simulator.scene import Scene, SceneTree
from services.simulator.warm import warm
from services.simulator.world import World


class StubCamera:
    """Renders what the aircraft would see among ``trees``."""

    def __init__(self, trees: list[Tree], seed: int) -> None:
        cv2.setNumThreads(1)
        warm()
        stems = tuple(
            SceneTree(t.x_m, t.y_m, t.z_m, t.axis, t.radius_m, seed=seed + t.id, taper=0.01, bumps=0.02) for t in trees
        )
        self._renderer = Renderer(World(Scene("stub", seed, stems)), DEFAULT_INTRINSICS)
        config = PreviewConfig()
        self._width_px = config.width_px
        self._encoder = Encoder(config.max_kb * 1000, config.best_quality)

    def picture(
        self, pose: Pose, trees: tuple[Tree, ...], target: Target | None, mission: MissionState, guidance: Guidance
    ) -> PreviewImage:
        """Return the preview of this moment."""
        assert pose.T_map_camera is not None
        image, factor = scaled(self._renderer.render(from_transform(pose.T_map_camera)).colour, self._width_px)
        draw(image, overlay_of(DEFAULT_INTRINSICS, pose, trees, target, mission, guidance), factor)
        return PreviewImage(self._encoder.encode(image))
