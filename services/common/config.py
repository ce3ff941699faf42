"""The one configuration tree; ``services.common.config_loader`` fills it from files, variables and flags."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from services.camera.config import CameraConfig
from services.cli.run_config import SupervisorConfig
from services.detector.config import DetectorServiceConfig
from services.detector.refine.config import RefinerConfig
from services.fine.config import FineConfig
from services.fusion.config import FusionConfig
from services.mapper.config import MapperConfig
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.config import NavigatorConfig
from services.preview.config import PreviewConfig
from services.recorder.config import RecorderConfig
from services.router.config import RouterConfig
from services.security.config import SecurityConfig
from services.simulator.config import SimulatorConfig
from services.slam.config import SlamConfig
from services.station.config import StationConfig


class TreedockConfig(BaseModel):
    """Configuration of the whole system; one field per service."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    uav: str = Field(default="uav1", min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.-]+$")
    """Name of the aircraft: a chunk of every key."""
    clock: Literal["wall", "sim"] = "wall"
    """``sim``: time is what ``sim/clock`` says."""
    clock_ahead_s: float = 0.0
    """Added to this machine's clock: for tests of machines whose clocks differ."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    background_gives_way: bool | None = None
    """Whether services that nobody flies by (mapper, detector, recorder, preview) run after the others where the processor is
    short. None: where a camera or a recording feeds them; beside a simulator, which takes all that is left, they would starve."""
    router: RouterConfig = RouterConfig()
    security: SecurityConfig = SecurityConfig()
    supervisor: SupervisorConfig = SupervisorConfig()
    camera: CameraConfig = CameraConfig()
    slam: SlamConfig = SlamConfig()
    fusion: FusionConfig = FusionConfig()
    mapper: MapperConfig = MapperConfig()
    detector: DetectorServiceConfig = DetectorServiceConfig()
    refiner: RefinerConfig = RefinerConfig()
    fine: FineConfig = FineConfig()
    """Of ``treedock process --fine``, not of a service."""
    simulator: SimulatorConfig = SimulatorConfig()
    recorder: RecorderConfig = RecorderConfig()
    preview: PreviewConfig = PreviewConfig()
    navigator: NavigatorConfig = Field(default_factory=NavigatorConfig)
    autopilot: AutopilotConfig = Field(default_factory=AutopilotConfig)
    station: StationConfig = StationConfig()

    @field_validator("uav")
    @classmethod
    def _not_the_grounds(cls, name: str) -> str:
        """Certificates ``station.NAME`` command every aircraft: this one's services would hold such."""
        if name == "station":
            raise ValueError("certificates of that name are the ground stations': give the aircraft another")
        return name

    @model_validator(mode="after")
    def _agrees(self) -> TreedockConfig:
        """Refuse sections that contradict each other.

        Certificates on a plain bus would guard nothing, an encrypted one without them admits nobody; a real aircraft neither flies
        on an open bus nor docks where its camera is blind.
        """
        encrypted = self.router.protocol != "tcp"
        if encrypted and self.security.folder is None:
            raise ValueError(f"router.protocol {self.router.protocol} needs security.folder (see `treedock certs`)")
        if self.security.folder is not None and not encrypted:
            raise ValueError("security.folder is set, but router.protocol is tcp: set it to tls, or to quic")
        if self.autopilot.vehicle == "real" and self.navigator.dock.min_m < self.camera.min_range_m:
            raise ValueError(
                f"navigator.dock.min_m {self.navigator.dock.min_m:g} is nearer than camera.min_range_m {self.camera.min_range_m:g}: the camera "
                "sees no trunk there"
            )
        if self.autopilot.vehicle == "real" and not encrypted and not self.router.local:
            raise ValueError(
                "autopilot.vehicle is real, and anybody who reaches router.host or router.listen_host could fly it: certificates "
                "and router.protocol = 'tls' (docs/operations.md), or '127.0.0.1' for both"
            )
        return self

    @property
    def vehicle_guessed(self) -> bool:
        """Whether a real camera looks and nobody said what the autopilot flies: the bridge then refuses to engage.

        Not refused here: without an aircraft (a live view, in the hand, calibration) there is nothing to say.
        """
        second = self.fusion.enabled and self.fusion.second.enabled and self.fusion.second.camera.real
        return (self.camera.real or second) and not self.autopilot.vehicle_said


def load_config(file: Path | None = None) -> TreedockConfig:
    """Return the configuration from its usual places and ``file`` (of ``--config``).

    Raises:
        InputError: a missing or broken file, an unknown key, an impossible value.
    """
    from services.common.config_loader import load

    return load(file).config
