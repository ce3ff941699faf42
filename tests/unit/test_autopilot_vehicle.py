"""A real camera beside an autopilot of which nobody said what it flies: a guess could ask a pilot to switch his sticks off."""

from __future__ import annotations

from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import common as mav

from schemas.topics import VEHICLE_STATE
from schemas.vehicle import VehicleState
from services.common.config import TreedockConfig
from services.common.context import Context
from services.common.memory import Hub
from services.common.session import free_port
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.parameters import wanted
from services.navigator.autopilot.service import build
from tests.unit.autopilot_rig import Rig

REAL_CAMERA = {"source": "realsense"}
SECOND = 1_000_000_000


def tree(camera: dict[str, Any], **more: Any) -> TreedockConfig:
    autopilot = {"connection": f"udpin:127.0.0.1:{free_port()}", "check_parameters": False, **more}
    return TreedockConfig.model_validate({"camera": camera, "autopilot": autopilot})


def note_of(config: TreedockConfig) -> str:
    hub = Hub(config)
    hub.clock.set_ns(SECOND)
    states: list[VehicleState] = []
    hub.context("station").on(VEHICLE_STATE, states.append)
    build(cast("Context", hub.context("autopilot")))
    hub.advance_to(2 * SECOND)
    hub.stop()
    return states[-1].note


def test_beside_a_real_camera_the_vehicle_is_not_guessed() -> None:
    note = note_of(tree(REAL_CAMERA))
    assert note.startswith("parameters: autopilot.vehicle"), "the doctor and preflight take it for a failure"
    assert "'real'" in note
    assert "'simulation'" in note


def test_a_second_real_camera_counts_too() -> None:
    fusion = {"enabled": True, "second": {"enabled": True, "camera": REAL_CAMERA}}
    config = TreedockConfig.model_validate({"fusion": fusion})
    assert config.vehicle_guessed


@pytest.mark.parametrize("vehicle", ["real", "simulation"])
def test_once_it_is_said_it_flies(vehicle: str) -> None:
    assert "autopilot.vehicle" not in note_of(tree(REAL_CAMERA, vehicle=vehicle))


@pytest.mark.parametrize("source", ["sim", "tum:/a", "mcap:/a.mcap", "bag:/a.bag"])
def test_beside_a_simulated_camera_or_a_recording_nothing_need_be_said(source: str) -> None:
    assert not tree({"source": source}).vehicle_guessed


def test_a_guessed_vehicle_is_neither_engaged_nor_given_parameters() -> None:
    rig = Rig()
    rig.bridge = Bridge(AutopilotConfig(set_parameters=True), vehicle_guessed=True)
    rig.guidance = {"engage": True, "mission_id": 1}
    rig.run(1.0)
    for parameter in wanted("simulation"):
        name = parameter.name.encode().ljust(16, b"\0")
        rig._hear(mav.MAVLink_param_value_message(name, 7.0, mav.MAV_PARAM_TYPE_REAL32, 1, 0))
    sent = {message.get_type() for message in rig.run(20.0)}
    assert "PARAM_SET" not in sent
    assert not rig.armed
    assert rig.bridge.engagement.phase != "engaged"
    assert rig.bridge.refusal().startswith("parameters: autopilot.vehicle")
