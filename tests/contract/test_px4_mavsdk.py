"""An independent client flies the simulated autopilot over UDP: arm, take off, offboard position, land."""

from __future__ import annotations

import importlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from services.simulator.px4.config import LinkConfig
from services.simulator.px4.modes import NavState
from services.simulator.px4.runner import RealTimeRunner
from tests.contract.px4_companion import TICK_S, Companion

SPEED = 2.5
"""Simulated time runs this much faster than the wall's."""


def need(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except Exception as error:  # noqa: BLE001  # a library that does not load on this platform, whatever the reason
        pytest.skip(f"{name} does not load here: {error}")


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def wait(what: str, true: Callable[[], bool], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, f"{what} did not happen within {seconds} s"
        time.sleep(0.02)


@contextmanager
def flying() -> Iterator[tuple[Companion, int]]:
    """A vehicle with vision on one link, in scaled wall time, and a UDP link for the client."""
    companion, port = Companion(seed=3), free_port()
    companion.run(3.0)
    companion.px4.listen(LinkConfig(local_port=0, remote_port=port, ground_station=True))
    with RealTimeRunner(companion.run, TICK_S, SPEED):
        yield companion, port
    companion.px4.close()


def test_mavsdk_arms_takes_off_flies_offboard_and_lands() -> None:
    sdk = need("mavsdk")
    action_module, offboard_module = need("mavsdk.plugins.action"), need("mavsdk.plugins.offboard")
    with flying() as (c, port):
        client = sdk.Mavsdk(sdk.Configuration.create_with_component_type(sdk.ComponentType.GROUND_STATION))
        try:
            client.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = client.first_autopilot(20.0)
            assert system is not None
            assert system.autopilot_type() == sdk.Autopilot.PX4
            action, offboard = action_module.Action(system), offboard_module.Offboard(system)
            _fly(c, action, offboard, offboard_module)
        finally:
            client.destroy()
    assert threading.active_count() < 50


def _fly(c: Companion, action: Any, offboard: Any, module: Any) -> None:
    action.set_gps_global_origin(47.397742, 8.545594, 488.0)
    wait("hold available", lambda: not c.px4.vehicle.commander.arming_fault())
    action.arm()
    wait("armed", lambda: c.px4.armed)
    action.takeoff()
    wait("take-off height", lambda: -float(c.true_ned()[2]) > 2.2)
    wait("hold after take-off", lambda: c.flies() is NavState.HOLD)
    goal = np.array([1.5, -1.0, -2.0])
    offboard.set_position_ned(module.PositionNedYaw(*(float(v) for v in goal), 45.0))
    offboard.start()
    wait("offboard", lambda: c.flies() is NavState.OFFBOARD)
    wait("the place", lambda: float(np.linalg.norm(c.true_ned() - goal)) < 0.25)
    T = c.px4.true_pose()
    wait("the heading", lambda: abs(np.degrees(-np.arctan2(*c.px4.true_pose()[[1, 0], 0])) - 45.0) < 6.0)
    assert T.shape == (4, 4)
    offboard.stop()
    wait("hold", lambda: c.flies() is NavState.HOLD)
    action.land()
    wait("landed and disarmed", lambda: c.px4.on_ground and not c.px4.armed)
