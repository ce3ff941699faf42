"""The autopilot process: the bridge on the bus on one side, on the wire on the other."""

from __future__ import annotations

import atexit
import logging

from schemas.navigation import Guidance
from schemas.slam import Pose
from schemas.topics import FUSION_POSE, MISSION_GUIDANCE, SLAM_POSE, VEHICLE_GPS, VEHICLE_IMU, VEHICLE_STATE
from services.common.context import Context
from services.fusion.config import FusionConfig
from services.navigator.autopilot.bridge import Bridge
from services.navigator.autopilot.config import AutopilotConfig
from services.navigator.autopilot.link import Codec, Link, MavlinkLink, read_secret
from services.navigator.autopilot.parameters import differences, table
from services.navigator.autopilot.sensors import Sensors
from services.navigator.autopilot.wire import open_wire

LOG = logging.getLogger(__name__)


class Autopilot:
    """Drives a bridge over a link."""

    def __init__(
        self, context: Context, config: AutopilotConfig, link: Link, fusion: FusionConfig | None = None, *,
        vehicle_guessed: bool = False,
    ) -> None:  # fmt: skip
        self._context = context
        self._link = link
        fusion = fusion or FusionConfig()
        self._fused = fusion.enabled
        imu_hz, gps_hz = fusion.imu_hz * fusion.imu, fusion.gps_hz * fusion.gps
        sensors = Sensors(imu_hz, gps_hz) if fusion.enabled else None
        self.bridge = Bridge(config, sensors, vehicle_guessed=vehicle_guessed)
        self._identified: int | None = None
        """The system as whose component we speak."""
        self._note = ""
        self._table_told = False
        self._told = 0
        """How many parameters were told to have been set."""

    def register(self) -> None:
        """Connect to the bus."""
        c, config = self._context, self.bridge.config
        c.on(FUSION_POSE if self._fused else SLAM_POSE, self._on_pose)
        c.on(MISSION_GUIDANCE, self._on_guidance)
        c.every(config.poll_s, self.tick)
        c.every(1.0 / config.state_hz, self._publish_state)

    def tick(self) -> None:
        """Take what came from the autopilot and send what is due."""
        for message, received_ns in self._link.poll():
            self.bridge.handle(message, received_ns)
        system = self.bridge.telemetry.system
        if system is not None and system != self._identified:
            self._link.identify(system)
            self._identified = system
        self._tell_sensors()
        self._send()

    def _tell_sensors(self) -> None:
        """Pass on what the raw sensors said, if fusion asked for it."""
        imu, fix = self.bridge.sensors.imu(), self.bridge.sensors.fix()
        if imu is not None:
            self._context.publish(VEHICLE_IMU, imu)
            self._context.health.count("imu_samples", len(imu.samples))
        if fix is not None:
            self._context.publish(VEHICLE_GPS, fix)
            self._context.health.count("gps_fixes")

    def _send(self) -> None:
        for message in self.bridge.tick(self._context.clock.now_ns()):
            self._link.send(message)

    def _on_pose(self, pose: Pose) -> None:
        self.bridge.on_pose(pose, self._context.clock.now_ns())
        self._send()

    def _on_guidance(self, guidance: Guidance) -> None:
        self.bridge.on_guidance(guidance, self._context.clock.now_ns())

    def _publish_state(self) -> None:
        now_ns = self._context.clock.now_ns()
        state = self.bridge.state(now_ns)
        self._context.publish(VEHICLE_STATE, state)
        if state.note != self._note:
            self._note = state.note
            LOG.info("%s (mode %s, %s)", state.note, state.mode, "armed" if state.armed else "disarmed")
        book = self._context.health
        book.counters["odometry_sent"] = self.bridge.vision.sent
        book.counters["setpoints_sent"] = self.bridge.setpoints_sent
        book.counters["setpoints_refused"] = self.bridge.setpoints_refused
        bridge = self.bridge
        self._tell_parameters()
        book.counters["clock_jumps"] = bridge.clocks.jumps
        if bridge.clocks.round_trip_ns is not None:
            book.counters["timesync_round_trip_us"] = bridge.clocks.round_trip_ns // 1000
        book.note("clocks", bridge.clocks.word(now_ns))
        book.note("controls", bridge.foreign.word(now_ns))
        book.note("navigators", bridge.engagement.others_word(now_ns))
        book.counters["guidance_of_others"] = bridge.engagement.of_others
        book.note("link", "" if state.connected else "no word from the autopilot: is it running, is the address right?")
        book.note("wire", getattr(self._link, "failed", ""))
        book.counters["mavlink_bad"] = getattr(self._link, "bad", 0)

    def _tell_parameters(self) -> None:
        """Say once how the vehicle's parameters stand, and each time that some were set."""
        reader, config = self.bridge.parameters, self.bridge.config
        if reader.complete and not self._table_told and config.check_parameters:
            self._table_told = True
            if differences(reader.found, config.vehicle):
                LOG.warning("parameters for a %s aircraft:\n%s", config.vehicle, table(reader.found, config.vehicle))
        if len(reader.changed) != self._told:
            self._told = len(reader.changed)
            was = ", ".join(f"{name} (was {value:g})" for name, value in reader.changed.items())
            LOG.warning("parameters set: %s; start the autopilot again, some take effect only then", was)


def build(context: Context) -> None:
    """Start the bridge on a context, over the wire that the configuration names."""
    config: AutopilotConfig = getattr(context.config, "autopilot", None) or AutopilotConfig()
    codec = Codec(config.component_id, config.system_id, context.clock.now_ns, read_secret(config.signing_key))
    stream = config.connection.startswith(("tcp:", "serial:"))
    reopen = (lambda: open_wire(config.connection)) if stream else None
    link = MavlinkLink(open_wire(config.connection), codec, reopen)
    atexit.register(link.close)
    on_stop = getattr(context, "on_stop", None)
    if on_stop is not None:
        on_stop(link.close)
    guessed = context.config.vehicle_guessed
    Autopilot(context, config, link, context.config.fusion, vehicle_guessed=guessed).register()
