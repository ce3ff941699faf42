"""Configuration of the simulated quadrotor: how imperfect it is, and where its MAVLink links go."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Share = Annotated[float, Field(ge=0.0, le=1.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Positive = Annotated[float, Field(gt=0.0)]


class AirframeConfig(BaseModel):
    """The body and its motors: a 1.5 kg quadrotor with ordinary faults."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mass_kg: Positive = 1.5
    leg_height_m: Positive = 0.1
    """Body origin above the ground when landed (the reference takes off from 0.1 m)."""
    thrust_lag_s: Positive = 0.05
    rate_lag_s: Positive = 0.035
    """Roll and pitch rate response of airframe and rate loop."""
    yaw_rate_lag_s: Positive = 0.08
    yaw_rate_gain: Positive = 0.92
    """Steady share of a commanded yaw rate that is reached: rotor drag against a slow integrator."""
    drag_n_s_m: NonNegative = 0.45
    """Linear drag of body and rotors, newtons per m/s of airspeed."""
    thrust_error: float = 0.04
    """The autopilot's belief of its thrust is wrong by this share."""
    max_acceleration_m_s2: Positive = 20.0
    """Thrust over mass at full throttle."""


class SensorConfig(BaseModel):
    """Inertial and barometric errors of a small autopilot board, vibration included."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    gyro_noise_rad_s: NonNegative = 0.006
    gyro_bias_rad_s: NonNegative = 0.003
    """Standard deviation from which the seed draws the constant bias."""
    gyro_walk_rad_s: NonNegative = 2e-5
    """Random walk, per square root of a second."""
    accel_noise_m_s2: NonNegative = 0.25
    accel_bias_m_s2: NonNegative = 0.08
    accel_walk_m_s2: NonNegative = 5e-4
    baro_noise_m: NonNegative = 0.12
    baro_drift_m: NonNegative = 0.3
    """Standard deviation of the barometer's slow error (correlated over a minute)."""


class WindConfig(BaseModel):
    """Steady wind and gusts (first-order Gauss-Markov), weaker near the ground."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mean_m_s: NonNegative = 0.8
    gust_m_s: NonNegative = 0.6
    gust_time_s: Positive = 2.5


class GpsConfig(BaseModel):
    """A GPS receiver under trees: errors, delay, and faults at times since the start. Absent unless asked for."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    present: bool = False
    rate_hz: Positive = 5.0
    white_m: NonNegative = 0.4
    """Horizontal noise from fix to fix, one axis."""
    slow_m: NonNegative = 1.2
    """Standard deviation of the slow error (first-order Gauss-Markov over ``slow_s``), one axis."""
    slow_s: Positive = 80.0
    vertical_factor: Positive = 1.8
    velocity_m_s: NonNegative = 0.15
    delay_s: NonNegative = 0.1
    outages_s: tuple[tuple[float, float], ...] = ()
    """(begin, end) of times without a fix."""
    jump_at_s: float | None = None
    jump_m: tuple[float, float] = (8.0, 6.0)
    """North and east: from ``jump_at_s`` on all fixes are off by this."""
    drag_from_s: float | None = None
    drag_m_s: tuple[float, float] = (0.15, -0.1)
    """North and east: from ``drag_from_s`` on the fixes are dragged away so fast (a spoofer that takes over softly)."""


class LinkConfig(BaseModel):
    """Where the endpoint talks: like PX4 it sends from a bound port to one remote."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    local_port: Annotated[int, Field(ge=0, le=65535)] = 14580
    remote_port: Annotated[int, Field(ge=0, le=65535)] = 14540
    ground_station: bool = False
    """A link of the ground station's kind: the only kind that carries STATUSTEXT."""


class Px4Config(BaseModel):
    """The simulated autopilot and aircraft."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    airframe: AirframeConfig = AirframeConfig()
    sensors: SensorConfig = SensorConfig()
    wind: WindConfig = WindConfig()
    gps: GpsConfig = GpsConfig()
    system_id: Annotated[int, Field(ge=1, le=255)] = 1
    step_s: Positive = 0.004
    battery_share: Share = 1.0
    battery_endurance_s: Positive = 1200.0
    """Hover time from full to empty."""
    boot_time_s: NonNegative = 12.0
    """What the autopilot's own clock shows when the simulation starts: never the companion's clock."""
    remote_control: bool = False
    """A radio control transmitter is connected from the start."""
    links: tuple[LinkConfig, ...] = (
        LinkConfig(),
        LinkConfig(local_port=18570, remote_port=14550, ground_station=True),
    )
    """Opened by ``SimulatedPx4.open_links``; the ports are PX4 SITL's."""
    parameters: dict[str, float] = {}
    """Parameters that differ from PX4's defaults with the vision set of params.py applied."""
