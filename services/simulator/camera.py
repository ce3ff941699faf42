"""The simulated camera: renders at full or at half size, and adds the sensor's faults."""

from __future__ import annotations

from schemas.camera import Intrinsics
from services.simulator.config import SensorConfig
from services.simulator.models import CAMERA_MODELS
from services.simulator.render import Renderer, halved
from services.simulator.scene import Floats
from services.simulator.sensor import RgbdSensor, SensorImages
from services.simulator.world import World


class SimulatedCamera:
    """An RGB-D camera in a world; gives full-size images, or ``small`` ones of half that in which only depth is of use."""

    def __init__(
        self, world: World, config: SensorConfig, reduced: bool = False, seed: int = 0, small: bool = False
    ) -> None:
        full: Intrinsics = CAMERA_MODELS[config.model].intrinsics
        self.intrinsics: Intrinsics = halved(full) if small else full
        rendered = self.intrinsics
        for _ in range(2 if small else int(reduced)):
            rendered = halved(rendered)
        self.render_scale = rendered.width / self.intrinsics.width
        self._renderer = Renderer(world, rendered)
        self._sensor = RgbdSensor(config, (rendered.height, rendered.width), self.render_scale, seed, rendered)

    def look(self, T_world_camera: Floats, seq: int) -> SensorImages:
        """Return the images at a pose; ``seq`` draws the noise."""
        return self._sensor.expose(self._renderer.render(T_world_camera), seq)
