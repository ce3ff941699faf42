"""The station process: joins the bus of all aircraft, the decisions of ``brain`` and the page.

The work loop decodes and decides; the web has its own thread; orders wait for their answers on threads of a small
pool. What passes between them goes through the inbox, so that one thread alone touches the state.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import secrets
import socket
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import zenoh

from schemas.command import CommandReply
from schemas.envelope import Message
from schemas.health import Health
from schemas.orders import STOPS
from schemas.preview import PreviewImage
from schemas.topics import (
    FLEET_HELD,
    FUSION_STATE,
    HEALTH,
    MISSION_STATE,
    PREFIX,
    PREVIEW_IMAGE,
    SLAM_POSE,
    TREES_LIST,
    TREES_TARGET,
    VEHICLE_STATE,
    Topic,
)
from schemas.trees import TreeList
from services.common.bus import Bus
from services.common.health import HealthReporter
from services.common.live_context import LiveContext
from services.navigator.client import send_command
from services.station.aircraft import Aircraft
from services.station.brain import Brain, Outgoing
from services.station.claims import Claims
from services.station.clouds import Clouds
from services.station.ears import Ears
from services.station.guard import Guard
from services.station.keeping import Keeping
from services.station.launch import open_browser
from services.station.preview import frame_of
from services.station.server import WebServer, bound_socket
from services.station.web import Site

LOG = logging.getLogger(__name__)

_REQUEST_RING = 512
_TOKEN_RING = 1_024
_TREES_RING = 8  # 1.6 s of an aircraft that tells five times a second
_ORDERS_AT_ONCE, _STOPS_AT_ONCE = 8, 16
"""An order to an aircraft that does not answer takes some seconds: one that makes safe waits behind no other."""
_NOT_ABOARD = frozenset({"router", "recorder"})
_TOPICS: dict[Topic, Callable[[Aircraft, Any], object]] = {
    SLAM_POSE: Aircraft.on_pose, MISSION_STATE: Aircraft.on_mission, VEHICLE_STATE: Aircraft.on_vehicle,
    TREES_TARGET: Aircraft.on_target, HEALTH: Aircraft.on_health, FLEET_HELD: Aircraft.on_held, FUSION_STATE: Aircraft.on_fusion,
}  # fmt: skip


class Station:
    """The station over Zenoh."""

    def __init__(self, context: LiveContext) -> None:
        self._context = context
        self.config = context.config.station
        self._buses: dict[str, Bus] = {}
        self._kept: list[object] = []
        self._strangers: set[str] = set()
        self._waiting: set[tuple[str, str]] = set()
        """Aircraft and service of tokens that came before anything else of that aircraft."""
        self._reporter = HealthReporter("station", context.health)
        self._orders = ThreadPoolExecutor(_ORDERS_AT_ONCE, thread_name_prefix="order")
        self._stops = ThreadPoolExecutor(_STOPS_AT_ONCE, thread_name_prefix="stop")
        token = self._token()
        self.site = Site(self.config, Guard(token, local=self.config.local), Ears(self.call, lambda: self.brain))
        self.brain = Brain(self.config, self.site, self._send_order, time.time_ns)
        self.clouds = Clouds(self.brain.cloud_watchers, self.site.one, self.call)
        self.brain.on_cloud_wish = lambda uav: self.clouds.wish(uav, self._buses[uav])
        self.keeping = Keeping(self.config.inventory, self.brain.log, context.health, self.call)
        self.site.downloads = self.keeping.downloads()
        self.claims = self._arbiter()
        self._told = context.inbox.mailbox(lambda call: call(), _REQUEST_RING)
        self._server = WebServer(self.site, self.config, self._bound())
        self.address = self._address(token)

    def _arbiter(self) -> Claims | None:
        """Return the arbiter of the fleet, where this station is the one that has it."""
        if not self.config.fleet.enabled:
            return None
        c = self._context
        claims = Claims(
            self.config.fleet, self.config.inventory, self.brain.log, c.health, self.keeping.laid, c.steady_ns
        )
        self.brain.fleet_view = claims.view
        return claims

    def _token(self) -> str:
        """Return what browsers must know: none on this machine alone, nor where certificates are asked for."""
        if self.config.local or self.config.tls_client_ca:
            return self.config.token
        return self.config.token or secrets.token_urlsafe(24)

    def _bound(self) -> socket.socket:
        return bound_socket(self.config.host, self.config.port, any_port=self.config.any_port)

    def _tell_address(self) -> None:
        LOG.info("the page is at %s", self.address)
        if self.config.address_file:
            path = Path(self.config.address_file)
            with contextlib.suppress(OSError):  # who waits for it goes on without
                path.touch(mode=0o600)  # it may hold the token
                path.write_text(self.address)
        if self.config.open_browser:
            open_browser(self.address)

    def _address(self, token: str) -> str:
        scheme = "https" if self.config.tls_certificate else "http"
        host = f"[{self.config.host}]" if ":" in self.config.host else self.config.host
        return f"{scheme}://{host}:{self._server.port}/" + (f"?token={token}" if token else "")

    def register(self) -> None:
        """Connect to the bus and open the page."""
        c = self._context
        tokens = c.inbox.mailbox(self._on_token, _TOKEN_RING)
        direct: zenoh.handlers.Callback[zenoh.Sample]
        direct = zenoh.handlers.Callback(lambda sample: c.inbox.put(tokens, sample), indirect=False)
        session = c.bus.session
        # a certificate for one aircraft allows that one's tokens only, and nothing that is wider
        for uav in ("*", self._context.uav):
            key = f"{PREFIX}/{uav}/live/*"
            self._kept.append(session.liveliness().declare_subscriber(key, direct, history=True))
        c.every_wall(1.0 / self.config.page_hz, lambda: self.brain.tell_state(time.monotonic()))
        c.every_wall(1.0, self._each_second)
        c.on_stop(self._stop)
        self.keeping.start()
        self._server.start()
        self._tell_address()

    def call(self, action: Callable[[], None]) -> None:
        """Have the work loop call ``action``; from any thread."""
        self._context.inbox.put(self._told, action)

    # -- aircraft

    def _on_token(self, sample: zenoh.Sample) -> None:
        parts = str(sample.key_expr).split("/")
        if len(parts) != 5 or parts[4] == "station":
            return
        uav, service = parts[2], parts[4]
        alive = sample.kind == zenoh.SampleKind.PUT
        if service in _NOT_ABOARD and uav not in self._buses:
            # the ground's own router makes no aircraft; it is told of once there is one of that name
            (self._waiting.add if alive else self._waiting.discard)((uav, service))
            return
        if self._bus_of(uav) is not None:
            self.brain.aircraft(uav).on_live(service[:64], alive=alive)

    def _bus_of(self, uav: str) -> Bus | None:
        """Return the bus of an aircraft, connected at its first sign of life; None when it is not ours."""
        bus = self._buses.get(uav)
        if bus is not None:
            return bus
        wanted = self.config.aircraft
        if (wanted and uav not in wanted) or len(self._buses) >= self.config.max_aircraft or len(uav) > 64:
            if len(self._strangers) < self.config.max_aircraft and uav not in self._strangers:
                self._strangers.add(uav)
                LOG.warning("aircraft %.64r is not shown: %s", uav, "not one of ours" if wanted else "too many")
            self._context.health.count("strangers")
            return None
        bus = self._buses[uav] = Bus(self._context.bus.session, uav, self._context.health, self._context.inbox)
        aircraft = self.brain.aircraft(uav)
        for topic, take in _TOPICS.items():
            bus.subscribe_keys(topic, functools.partial(self._on_message, aircraft, topic, take))
        # each list replaces the last, and decoding them is most of the work: on a busy machine old ones give way to the state
        bus.subscribe(TREES_LIST, functools.partial(self._on_trees, aircraft), ring=_TREES_RING)
        bus.subscribe(PREVIEW_IMAGE, functools.partial(self._on_preview, aircraft))
        if self.claims is not None:
            self.claims.attach(aircraft, bus)
        for early in sorted(pair for pair in self._waiting if pair[0] == uav):
            self._waiting.discard(early)
            aircraft.on_live(early[1], alive=True)
        return bus

    def _on_message(
        self, aircraft: Aircraft, topic: Topic, take: Callable[[Aircraft, Any], object], key: str, message: Message
    ) -> None:
        if isinstance(message, Health) and (message.service == "station" or not key.endswith(f"/{message.service}")):
            return
        name = key.split("/", 3)[3]
        aircraft.links.note(topic, name, time.monotonic(), getattr(message, "seq", None))
        before = aircraft.mission
        take(aircraft, message)
        self._context.health.count("messages")
        now = aircraft.mission
        if (
            now is not before
            and now is not None
            and before is not None
            and now.visited_tree_ids != before.visited_tree_ids
        ):
            self.keeping.trees(aircraft)

    def _on_trees(self, aircraft: Aircraft, message: TreeList) -> None:
        aircraft.links.note(TREES_LIST, TREES_LIST.name, time.monotonic(), None)
        self._context.health.count("messages")
        if aircraft.on_trees(message):
            self.keeping.trees(aircraft)

    def _on_preview(self, aircraft: Aircraft, message: PreviewImage) -> None:
        aircraft.links.note(PREVIEW_IMAGE, PREVIEW_IMAGE.name, time.monotonic(), None)
        self._context.health.count("messages")
        self.site.latest(f"preview/{aircraft.uav}", frame_of(aircraft.uav, message.jpeg))

    # -- orders

    def _send_order(self, order: Outgoing) -> None:
        bus, given_s = self._buses[order.uav], time.monotonic()

        def ask() -> None:
            reply: CommandReply | None = None
            waited_s = time.monotonic() - given_s
            if waited_s > self.config.view_stale_s and order.name not in STOPS:
                reason = f"it waited {waited_s:.1f} s in the station behind other orders: look, and press again"
                reply = CommandReply(accepted=False, reason=reason, state="unknown")
            else:
                try:
                    reply = send_command(bus, order.name, order.tree_id, order.sender, self.config.command_timeout_s)
                except zenoh.ZError as error:  # the session is closing or the router away
                    LOG.warning("order %s to %s failed: %s", order.name, order.uav, error)
            self.call(lambda: self.brain.on_answer(order, reply))

        (self._stops if order.name in STOPS else self._orders).submit(ask)

    # -- once a second, and the end

    def _each_second(self) -> None:
        self.brain.tell_trees()
        self.clouds.each_second()
        passed: Counter[str] = Counter()
        for bus in self._buses.values():
            bus.count_overflows()
            passed += bus.passed
        health = self._reporter.report(self._context.wall.now_ns(), passed)
        for uav, bus in self._buses.items():
            if uav != self._context.uav:  # the runtime tells that one itself
                bus.publish(HEALTH, health, "station")
        self._context.health.counters["pages"] = len(self.brain.sessions)
        self._context.health.counters["refused_requests"] = self.brain.refused
        self._context.health.counters["slow_pages"] = self.site.cut_off

    def _stop(self) -> None:
        if self.claims is not None:
            self.claims.close()
        self.keeping.close()
        self._server.stop()
        self.clouds.close()
        for pool in (self._orders, self._stops):
            pool.shutdown(wait=False, cancel_futures=True)


def build(context: LiveContext) -> Station:
    """Set the station up on a live context."""
    station = Station(context)
    station.register()
    return station
