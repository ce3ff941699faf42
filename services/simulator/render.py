"""Perfect colour and depth images of a world from a camera pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from schemas.camera import Intrinsics
from services.simulator import texture
from services.simulator.scene import Floats
from services.simulator.world import Floats32, World

DEFAULT_INTRINSICS = Intrinsics(width=640, height=480, fx=500.0, fy=500.0, cx=319.5, cy=239.5, depth_scale=1000.0)


@dataclass(frozen=True, slots=True)
class Rendering:
    """Images without any sensor fault."""

    colour: NDArray[np.uint8]
    """(H, W, 3) BGR."""
    depth_m: Floats32
    """(H, W) along the optical axis; infinite where there is only sky."""


def halved(intrinsics: Intrinsics) -> Intrinsics:
    """Return the intrinsics of the image at half size (pixel u of it covers 2u and 2u + 1 of the full one)."""
    return intrinsics.model_copy(
        update={
            "width": intrinsics.width // 2, "height": intrinsics.height // 2,
            "fx": intrinsics.fx / 2, "fy": intrinsics.fy / 2,
            "cx": (intrinsics.cx - 0.5) / 2, "cy": (intrinsics.cy - 0.5) / 2,
        }
    )  # fmt: skip


class Renderer:
    """Renders a world with a pinhole camera. Buffers are reused: an image is valid until the next call."""

    def __init__(self, world: World, intrinsics: Intrinsics) -> None:
        self.world = world
        self.intrinsics = intrinsics
        shape = (intrinsics.height, intrinsics.width)
        u, v = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
        x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
        self._directions = np.stack([x, y, np.ones(shape)], axis=-1).astype(np.float32)
        self._rays = np.empty((*shape, 6), dtype=np.float32)
        self._colour = np.empty((*shape, 3), dtype=np.uint8)
        self._table = texture.lattice(world.scene.seed)
        self._palette = texture.palette()
        self._sun = np.array([0.45, -0.35, 0.82], dtype=np.float32)

    def render(self, T_world_camera: Floats) -> Rendering:
        """Return what an ideal camera at ``T_world_camera`` (4, 4) sees."""
        _aim(self._directions, T_world_camera.astype(np.float32), self._rays)
        hits = self.world.cast(self._rays)
        texture.paint(
            self._table, self._palette, self.world.material, self._rays, hits.distance, hits.part, hits.normal,
            self._sun, np.float32(1.0 / min(self.intrinsics.fx, self.intrinsics.fy)), self._colour,
        )  # fmt: skip
        return Rendering(self._colour, hits.distance)


@njit(cache=True, nogil=True, error_model="numpy")
def _aim(directions: Floats32, T: Floats32, rays: Floats32) -> None:
    """Turn camera directions with z = 1 into world rays: their hit distance is the depth."""
    for v in range(directions.shape[0]):
        for u in range(directions.shape[1]):
            x, y, z = directions[v, u, 0], directions[v, u, 1], directions[v, u, 2]
            for i in range(3):
                rays[v, u, i] = T[i, 3]
                rays[v, u, 3 + i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z
