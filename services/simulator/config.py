"""Configuration of the simulator."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from services.simulator.px4.config import LinkConfig, Px4Config

SensorName = Literal["own", "kinect1", "kinect2", "r200", "d435", "bumblebee2"]


class SensorConfig(BaseModel):
    """The camera's faults: an active stereo camera outdoors, and a cheap accelerometer."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: SensorName = "own"
    """``own``: what the fields below say; another: that camera's image and figures (models.py), except for fields below
    that differ from their defaults."""
    sunlight: bool = False
    """Direct sun on everything: stereo does not mind, structured light sees nothing, time of flight is not modelled."""
    law: Literal["stereo", "time_of_flight"] = "stereo"
    """``stereo``: noise in the disparity, the next fields; ``time_of_flight``: Fankhauser et al., "Kinect v2 for mobile
    robot navigation" (2015)."""
    disparity_sigma_px: float = Field(default=0.08, ge=0.0, le=1.0)
    """Matching noise s; 0 gives perfect depth within the range, without edges or holes."""
    fixed_share: float = Field(default=0.4, ge=0.0, le=1.0)
    """Share of the noise's variance that is the same in every frame."""
    disparity_step_px: float = Field(default=0.0, ge=0.0, le=1.0)
    """Disparity comes in whole steps of this; 0: as fine as may be."""
    focal_px: float = Field(default=565.0, gt=0.0)
    baseline_m: float = Field(default=0.070, gt=0.0)
    min_range_m: float = Field(default=0.5, ge=0.0)
    fade_range_m: float = Field(default=6.0, gt=0.0)
    """Beyond this depth thins out, until ``max_range_m``, where there is none."""
    max_range_m: float = Field(default=8.0, gt=0.0, le=65.0)
    dropout: float = Field(default=0.01, ge=0.0, le=0.4)
    """About the share of pixels without data on a plain surface."""
    colour_sigma: float = Field(default=2.0, ge=0.0)
    exposure_swing: float = Field(default=0.04, ge=0.0, le=0.5)
    accel_sigma_m_s2: float = Field(default=0.08, ge=0.0)
    accel_bias_m_s2: float = Field(default=0.08, ge=0.0)

    @model_validator(mode="after")
    def _known_in_sunlight(self) -> Self:
        if self.sunlight and (self.model == "kinect2" or self.law == "time_of_flight"):
            raise ValueError("sunlight: how a time-of-flight camera fares in it is not modelled; set it to false")
        return self


class PathConfig(BaseModel):
    """The scripted path: rise, turn, face the nearest suitable tree, approach."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start_height_m: float = Field(default=0.1, gt=0.0)
    height_m: float = Field(default=1.5, gt=0.0)
    turn_rate_rad_s: float = Field(default=0.5236, gt=0.0, le=2.0)
    speed_m_s: float = Field(default=0.5, gt=0.0)
    dock_distance_m: float = Field(default=0.95, gt=0.3)
    rest_s: float = Field(default=1.0, ge=0.0)
    hold_s: float = Field(default=1.5, ge=0.0)
    """At the end, docked."""
    sway_m: float = Field(default=0.02, ge=0.0)
    tilt_rad: float = Field(default=0.017, ge=0.0)
    """Amplitude of roll and pitch."""


class FlightConfig(BaseModel):
    """How simulated time runs while the loop is closed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    wait_for: tuple[str, ...] = ("camera", "slam", "mapper", "detector", "refiner", "navigator", "autopilot")
    """Simulated time begins when these services live."""
    lead_s: float = Field(default=0.1, gt=0.0, le=1.0)
    """Simulated time is at most so far ahead of what autopilot and navigator said last."""
    hung_after_s: float = Field(default=2.0, gt=0.0)
    """Wall time after which time goes on without a living service that does not answer, until it does."""
    max_speed: float = Field(default=2.0, gt=0.0, le=20.0)
    """Simulated seconds per second at most; 1 at most while a service is missing."""
    drop_share: float = Field(default=0.0, ge=0.0, lt=0.9)
    """Share of the camera's frames that never arrive, drawn from the simulator's seed."""
    limit_s: float = Field(default=600.0, gt=0.0)
    """Simulated time after which the flight is broken off."""
    again: bool = False
    """The aircraft may start once more after a landing: a landing does not end the simulation."""


class ExternalConfig(BaseModel):
    """A PX4 that runs elsewhere, in real time; its true pose carries our camera."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    endpoint: str = "udpin:127.0.0.1:14540"
    """Where that PX4 speaks MAVLink: ``udpin:HOST:PORT`` listens, ``udpout:HOST:PORT`` speaks first."""
    bridge: str = "udpout:127.0.0.1:14541"
    """Where our autopilot bridge listens: it gets everything but the truth."""
    truth_rate_hz: float = Field(default=50.0, ge=10.0, le=250.0)
    truth_silent_s: float = Field(default=1.0, gt=0.0)


class SimulatorConfig(BaseModel):
    """The simulator service."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scene: str = "random-mission"
    """A name of the catalogue (multi-03), or random-KIND: then ``seed`` draws the scene."""
    seed: int = Field(default=1, ge=0)
    trees: int | None = Field(default=None, ge=0, le=12)
    """Suitable trees asked for in a random scene."""
    start_m: tuple[float, float] = (0.0, 0.0)
    """Where the aircraft stands in the scene (flight): each of a fleet has a place of its own."""
    rate_hz: float = Field(default=15.0, gt=0.0, le=60.0)
    clock_rate_hz: float = Field(default=100.0, gt=0.0, le=1000.0)
    reduced: bool = False
    """Render 320x240 and scale up: for slow machines."""
    small: bool = False
    """Give 320x240 images, rendered at 80x60: for tests in which somebody stands in for slam and refiner. The live guard still
    sees what is there; let ``sensor.disparity_sigma_px`` be 0, or the edges are as wide as the trunks."""
    mode: Literal["flight", "scan", "external"] = "flight"
    """flight: on the simulated aircraft; scan: on the scripted path; external: on the aircraft of another simulator."""
    flight: FlightConfig = FlightConfig()
    px4: Px4Config = Px4Config(links=(LinkConfig(),))
    external: ExternalConfig = ExternalConfig()
    answer_timeout_s: float = Field(default=10.0, gt=0.0)
    """Wall time that slam and refiner have for a frame before simulated time goes on without them."""
    body_radius_m: float = Field(default=0.25, gt=0.0)
    """The aircraft as a ball round the camera, for touches."""
    sensor: SensorConfig = SensorConfig()
    path: PathConfig = PathConfig()
