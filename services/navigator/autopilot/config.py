"""Configuration of the bridge to the autopilot."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from services.common.config_types import Near


class AutopilotConfig(BaseModel):
    """Where the autopilot is, how the camera sits on the aircraft, rates and time limits."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    connection: str = Field(default="udpin:127.0.0.1:14540", min_length=1)
    """``udpin:HOST:PORT``, ``udpout:HOST:PORT``, ``tcp:HOST:PORT`` or ``serial:DEVICE:BAUD``."""
    vehicle: Literal["simulation", "real"] = "simulation"
    """Which parameters preflight asks for: on a real aircraft the sticks must win. To be said where a serial line leads there,
    and beside a real camera: the bridge engages nothing of which it is not known."""
    check_parameters: bool = True
    """Refuse to engage while a parameter that a flight rests on is not as it has to be."""
    set_parameters: bool = False
    """Set those that differ, on the ground and disarmed; some take effect when the autopilot is started again."""
    signing_key: str = ""
    """File with the secret of MAVLink signing (32 bytes are made of it by SHA-256); empty: messages are not signed.
    With it, messages that are not signed with the same secret are refused."""
    system_id: int = Field(default=1, ge=1, le=255)
    """Ours until the autopilot's first heartbeat; then the autopilot's own."""
    component_id: int = Field(default=191, ge=1, le=255)
    camera_offset_m: tuple[Near, Near, Near] = (0.0, 0.0, 0.0)
    """Camera centre in body (forward, left, up)."""
    camera_pitch_rad: float = Field(default=0.0, ge=-3.2, le=3.2)
    """Camera looking down is positive."""
    camera_yaw_rad: float = Field(default=0.0, ge=-3.2, le=3.2)
    origin_lat_deg: float = Field(default=-38.0, ge=-90.0, le=90.0)
    origin_lon_deg: float = Field(default=176.0, ge=-180.0, le=180.0)
    origin_alt_m: float = Field(default=300.0, ge=-500.0, le=9000.0)
    """A made-up place on earth for the local origin: with it PX4 offers Hold and Return, which ask for a global
    position; nothing of ours depends on it."""
    poll_s: float = Field(default=0.01, gt=0.0, le=0.1)
    odometry_hz: float = Field(default=30.0, ge=10.0, le=100.0)
    setpoint_hz: float = Field(default=25.0, ge=10.0, le=100.0)
    state_hz: float = Field(default=20.0, ge=5.0, le=100.0)
    propagate_s: float = Field(default=0.30, ge=0.0, le=0.5)
    """Longest time for which a pose is carried on at constant velocity; then vision falls silent."""
    send_velocity: bool = False
    position_sigma_m: float = Field(default=0.01, gt=0.0, le=1.0)
    """Least standard deviations told with the vision pose."""
    angle_sigma_rad: float = Field(default=0.005, gt=0.0, le=0.5)
    setpoint_reach_m: float = Field(default=2.0, gt=0.5, le=20.0)
    """A setpoint farther than this from where the aircraft is belongs to no sane mission (its leash is 0.6 m): hold."""
    guidance_stale_s: float = Field(default=0.4, gt=0.0, le=5.0)
    guidance_land_s: float = Field(default=6.0, gt=0.0, le=60.0)
    """Without guidance for this long: land. Longer than a navigator takes to be started again."""
    link_lost_s: float = Field(default=1.0, gt=0.0, le=10.0)
    stream_before_offboard_s: float = Field(default=1.5, gt=1.0, le=30.0)
    engage_timeout_s: float = Field(default=12.0, gt=0.0, le=300.0)
    """Patience with each of vision, mode and arming, asked for again and again: PX4's checks pass late after its start."""

    @property
    def vehicle_said(self) -> bool:
        """Whether ``vehicle`` was set by somebody."""
        return "vehicle" in self.model_fields_set

    @model_validator(mode="after")
    def _sticks_win(self) -> AutopilotConfig:
        """Refuse to guess what a serial line leads to: a real aircraft taken for a simulated one is asked to switch its sticks off."""
        if self.connection.startswith("serial:") and not self.vehicle_said:
            raise ValueError(
                "autopilot.connection is a serial line: say autopilot.vehicle = 'real', or 'simulation' for hardware in the loop"
            )
        return self
