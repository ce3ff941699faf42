"""The simulated PX4 as others use it: aircraft, autopilot and MAVLink endpoint, stepped in anybody's time."""

from __future__ import annotations

import math

from services.common.geometry import Matrix
from services.simulator.px4.config import LinkConfig, Px4Config
from services.simulator.px4.flight import Sticks
from services.simulator.px4.links import Link, UdpLink
from services.simulator.px4.mavlink_server import MavlinkServer, Port
from services.simulator.px4.modes import NavState
from services.simulator.px4.quadrotor import GroundHeight
from services.simulator.px4.vehicle import Vehicle


class SimulatedPx4:
    """A quadrotor with PX4's behaviour on MAVLink links.

    ``ground_height_m(x, y)``: the scene's ground, world frame, metres. ``T_world_body``: start pose, body FLU; put z at
    ground plus ``config.airframe.leg_height_m``. Time passes only in :meth:`step`. Same arguments and same datagrams
    at the same ticks give the same flight, bit by bit.
    """

    def __init__(self, ground_height_m: GroundHeight, T_world_body: Matrix, config: Px4Config, seed: int) -> None:
        self.config = config
        self._server = MavlinkServer(config.system_id)
        self.vehicle = Vehicle(ground_height_m, T_world_body, config, seed, self._server.say)
        self._server.serve(self.vehicle)
        self._debt_s = 0.0
        self._links: list[Link] = []

    # -- links ---------------------------------------------------------------------------------------------------

    def attach(self, link: Link, *, ground_station: bool = False) -> Port:
        """Serve one more link."""
        self._links.append(link)
        return self._server.attach(link, ground_station=ground_station)

    def open_links(self) -> list[tuple[str, int]]:
        """Open the configured UDP links and return where they are bound.

        Raises:
            InputError: a port is taken.
        """
        return [self.listen(link) for link in self.config.links]

    def listen(self, config: LinkConfig) -> tuple[str, int]:
        """Open a UDP link and return the host and port it is bound to."""
        link = UdpLink(config)
        self.attach(link, ground_station=config.ground_station)
        return link.address

    def close(self) -> None:
        """Close all links."""
        for link in self._links:
            link.close()

    # -- time ----------------------------------------------------------------------------------------------------

    def step(self, dt_s: float) -> None:
        """Let ``dt_s`` pass; what is less than one tick is carried over."""
        self._debt_s += dt_s
        tick_s = self.config.step_s
        while self._debt_s >= tick_s - 1e-9:
            self._debt_s -= tick_s
            self._server.poll()
            self.vehicle.step()
            self._server.stream()

    @property
    def elapsed_s(self) -> float:
        """Simulated time since the start."""
        return self.vehicle.ticks * self.config.step_s

    # -- truth, for the simulator and for tests ------------------------------------------------------------------

    def true_pose(self) -> Matrix:
        """Return the true ``T_world_body`` (4x4, FLU)."""
        return self.vehicle.true_pose()

    @property
    def on_ground(self) -> bool:
        """The legs truly touch the ground."""
        return self.vehicle.body.contact

    @property
    def armed(self) -> bool:
        """Motors are armed."""
        return self.vehicle.commander.armed

    @property
    def mode(self) -> NavState:
        """The mode that flies."""
        return self.vehicle.commander.state

    @property
    def counters(self) -> dict[str, int]:
        """What was dropped or refused, by kind."""
        unpackable = sum(port.unpackable for port in self._server.ports)
        return {**self._server.counters, **({"unpackable": unpackable} if unpackable else {})}

    # -- the operator and faults ---------------------------------------------------------------------------------

    def pilot_takes(self, mode: NavState = NavState.POSITION) -> bool:
        """Throw the pilot's mode switch: the transmitter is on and the wanted mode is ``mode``."""
        self.vehicle.commander.remote_control = True
        return self.vehicle.commander.request_mode(mode)

    def pilot_sticks(self, sticks: Sticks) -> None:
        """Move the pilot's sticks, flown in POSITION mode (ALTITUDE: the vertical one)."""
        self.vehicle.modes.sticks = sticks

    def set_battery(self, share: float) -> None:
        """Set the battery's state of charge, 0..1."""
        self.vehicle.battery_share = share

    def place(self, T_world_body: Matrix) -> None:
        """Put the standing aircraft elsewhere (a scene's start); only while disarmed."""
        if self.armed:
            msg = "simulated autopilot: an armed aircraft cannot be carried elsewhere"
            raise RuntimeError(msg)
        self.vehicle.put(T_world_body)

    def link_age_s(self) -> float:
        """Return the time since the companion's last heartbeat, infinite before the first."""
        last = self.vehicle.last_companion_s
        return math.inf if math.isinf(last) else self.vehicle.now_s - last
