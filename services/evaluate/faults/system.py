"""The configurations that faults are flown with: small pictures, a calm simulated aircraft, ports of its own."""

from __future__ import annotations

import socket
from pathlib import Path

from services.camera.config import CameraConfig
from services.common.config import TreedockConfig
from services.common.session import free_port
from services.fusion.config import FusionConfig, SecondCameraConfig
from services.simulator.config import FlightConfig, SensorConfig
from services.simulator.px4.config import LinkConfig, Px4Config
from services.station.launch import with_station

SPEED = 4.0
"""Simulated seconds a second at most; a busy machine is slower, and so is a flight in which somebody is missing."""


def flight_config(seed: int, folder: Path, *, speed: float = SPEED, fused: bool = False) -> TreedockConfig:
    """Return the configuration of missions without rendering, one after the other in one simulation.

    The forest is drawn from ``seed``; ``speed``: simulated seconds a second at most; ``fused``: with fusion and a second camera.
    """
    base = TreedockConfig()
    port = _free_udp_port()
    simulator = base.simulator.model_copy(update={
        "scene": "random-mission", "seed": seed, "small": True,
        "sensor": SensorConfig(disparity_sigma_px=0.0),
        "flight": FlightConfig(max_speed=speed, again=True, limit_s=1e9),
        # a battery for a day: what is flown here is faults, not endurance
        "px4": Px4Config(links=(LinkConfig(local_port=0, remote_port=port),), battery_endurance_s=1e6),
    })  # fmt: skip
    tree = base.model_copy(update={
        "clock": "sim",
        "router": base.router.model_copy(update={"port": free_port(base.router.host)}),
        "camera": base.camera.model_copy(update={"source": "sim"}),
        # so that the next mission begins where this one did, not beside a tree
        "navigator": base.navigator.model_copy(update={"return_home": True}),
        "autopilot": base.autopilot.model_copy(update={"connection": f"udpin:127.0.0.1:{port}"}),
        "recorder": base.recorder.model_copy(update={"folder": folder / "recordings", "reserve_mb": 0}),
        "simulator": simulator,
        "fusion": _fusion() if fused else base.fusion,
    })  # fmt: skip
    return with_station(tree, folder)


def _fusion() -> FusionConfig:
    """Return fusion of slam, the autopilot's IMU and a second camera that looks down."""
    return FusionConfig(enabled=True, second=SecondCameraConfig(enabled=True, camera=CameraConfig(source="sim")))


def _free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
