"""THE table: every key of the system, who speaks, who listens, how often, how far it reaches.

Liveness, quality of service, access control, recording, documentation and tests derive from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal

from schemas.camera import RgbdFrame
from schemas.codec import Wire
from schemas.command import Command, NonceRequest
from schemas.envelope import Message
from schemas.fleet import ClaimRequest, HeldState
from schemas.fusion import FusionState
from schemas.health import Health
from schemas.mapping import GroundPatch, MapIndex, Submap
from schemas.navigation import Guidance, MissionState
from schemas.preview import PreviewImage
from schemas.simulation import SimClock, SimTruth
from schemas.sketch import SubmapSketch
from schemas.slam import Graph, Keyframe, Pose
from schemas.timekeeping import ClockRequest
from schemas.trees import Target, TreeList
from schemas.vehicle import GpsFix, ImuSamples, VehicleState

PREFIX = "treedock/v1"


class Reach(Enum):
    """How far a key may travel."""

    HOST = "host"
    AIRCRAFT = "aircraft"
    RADIO = "radio"


class Delivery(Enum):
    """How a sample reaches its consumers."""

    LATEST = "latest"
    """Dropped under congestion; a consumer keeps the newest one only."""
    STREAM = "stream"
    """Dropped under congestion; a consumer keeps a short ring of recent ones."""
    ADVANCED = "advanced"
    """Advanced publisher: cache, recovery of misses, late joiners get the history."""
    QUERY = "query"
    """Query and reply."""


Priority = Literal["real_time", "interactive_high", "data_high", "data", "data_low", "background"]


@dataclass(frozen=True)
class Topic:
    """One row of the table."""

    name: str
    """Key below ``treedock/v1/{uav}/``; a trailing ``*`` stands for one chunk (a service's or command's name)."""
    message: type[Wire]
    producer: str
    consumers: tuple[str, ...]
    rate_hz: float
    """Expected rate; 0: on change."""
    timeout_s: float | None
    """Silence beyond this is a fault; None: silence is no fault."""
    reach: Reach
    delivery: Delivery
    priority: Priority = "data"
    express: bool = False
    cache: int = 1
    """Samples that an advanced publisher keeps for late joiners."""
    recorded: bool = True
    radio_hz: float = 0.0
    """Behind a router's radio interface the key is thinned to this rate; 0: every sample passes."""
    beside: bool = False
    """Of another camera, or the same told another way: who shows or reports the one aircraft passes it over."""
    description: str = ""

    @property
    def encoding(self) -> str:
        """Return the Zenoh encoding string."""
        return self.message.encoding()

    @property
    def max_bytes(self) -> int:
        """Return the largest sample that is accepted."""
        return getattr(self.message, "MAX_BYTES", Message.MAX_BYTES)

    def key(self, uav: str, leaf: str | None = None) -> str:
        """Return the full key expression for an aircraft; ``leaf`` replaces the trailing ``*``."""
        name = self.name if leaf is None else self.name.removesuffix("*") + leaf
        return f"{PREFIX}/{uav}/{name}"


_H, _A, _R = Reach.HOST, Reach.AIRCRAFT, Reach.RADIO
_LATEST, _STREAM, _ADVANCED, _QUERY = Delivery.LATEST, Delivery.STREAM, Delivery.ADVANCED, Delivery.QUERY
ANY = "*"
"""Every service (health, liveness)."""

CAMERA_RGBD = Topic("camera/rgbd", RgbdFrame, "camera", ("slam", "refiner", "navigator", "preview"), 15, 1.0, _H, _LATEST, "data",
                    description="colour and registered depth, raw")  # fmt: skip
SECOND_RGBD = Topic("second/rgbd", RgbdFrame, "second_camera", ("second_slam",), 15, 1.0, _H, _LATEST, "data", recorded=False,
                    beside=True, description="the second camera's frames, raw; only where there is one")  # fmt: skip
SECOND_POSE = Topic("second/pose", Pose, "second_slam", ("fusion", "simulator"), 15, 0.5, _A, _STREAM, "interactive_high", express=True,
                    beside=True, description="the second camera in a map of its own, for fusion alone")  # fmt: skip
CAMERA_COMPRESSED = Topic("camera/rgbd_compressed", RgbdFrame, "camera", ("slam", "refiner", "navigator", "recorder"), 0, None, _A, _LATEST, "data_low",
                          description="the same as JPEG and PNG, sent only while somebody listens")  # fmt: skip
SLAM_POSE = Topic("slam/pose", Pose, "slam", ("refiner", "detector", "navigator", "autopilot", "simulator", "station", "preview", "fusion"), 15, 0.5, _R, _STREAM,
                  "interactive_high", radio_hz=5, express=True, description="camera in map for each frame, with covariance")  # fmt: skip
FUSION_POSE = Topic("fusion/pose", Pose, "fusion", ("navigator", "autopilot"), 15, 0.5, _A, _STREAM, "interactive_high", express=True,
                    beside=True, description="slam's pose, carried on where slam is lost: taken instead of slam/pose while fusion is on")  # fmt: skip
FUSION_STATE = Topic("fusion/state", FusionState, "fusion", ("station", "evaluate"), 2, 3.0, _R, _STREAM, "data_high", radio_hz=1,
                     description="what carries the pose, whether the GPS is believed, the place on the earth")  # fmt: skip
SLAM_KEYFRAME = Topic("slam/keyframe", Keyframe, "slam", ("mapper",), 0, None, _A, _ADVANCED, "data", cache=64,
                      description="keyframe with compressed depth")  # fmt: skip
SLAM_GRAPH = Topic("slam/graph", Graph, "slam", ("mapper",), 0, None, _A, _ADVANCED, "data_high",
                   description="all keyframe poses after a correction")  # fmt: skip
MAP_CLOUD = Topic("map/cloud", Submap, "mapper", ("detector",), 0, None, _A, _STREAM, "data_low",
                  description="submaps as they change; a queryable answers with the whole map, or with those that SubmapsWanted names")  # fmt: skip
MAP_SKETCH = Topic("map/sketch", SubmapSketch, "mapper", ("station",), 0, None, _R, _STREAM, "background", recorded=False,
                   description="submaps thinned for the 3D view over the radio, sent only while somebody looks; a queryable answers with the whole")  # fmt: skip
MAP_INDEX = Topic("map/index", MapIndex, "mapper", ("detector",), 0, None, _A, _LATEST, "data_low",
                  description="what the map holds: who holds less has missed a delta")  # fmt: skip
MAP_GROUND = Topic("map/ground", GroundPatch, "mapper", ("recorder",), 0, None, _A, _STREAM, "data_low",
                   description="ground per cell as it changes: height, slope, relief; a queryable answers with the whole")  # fmt: skip
TREES_LIST = Topic("trees/list", TreeList, "detector", ("refiner", "navigator", "station", "preview"), 0, None, _R, _ADVANCED, "data_high",
                   description="all trees known; a queryable answers with the latest")  # fmt: skip
TREES_TARGET = Topic("trees/target", Target, "refiner", ("detector", "navigator", "simulator", "station", "preview"), 15, 0.5, _R, _STREAM,
                     "interactive_high", radio_hz=5, express=True, description="the target trunk in the depth image")  # fmt: skip
MISSION_STATE = Topic("mission/state", MissionState, "navigator", ("refiner", "autopilot", "station", "preview"), 5, 1.0, _R, _STREAM,
                      "interactive_high", radio_hz=5, express=True, description="the mission's state, its reason, the target")  # fmt: skip
MISSION_GUIDANCE = Topic("mission/guidance", Guidance, "navigator", ("autopilot", "simulator", "preview"), 20, 0.3, _A, _STREAM,
                         "interactive_high", express=True, description="one of eight commands with its setpoint")  # fmt: skip
VEHICLE_STATE = Topic("vehicle/state", VehicleState, "autopilot", ("navigator", "slam", "simulator", "station"), 20, 0.5, _R, _STREAM,
                      "interactive_high", radio_hz=5, express=True, description="mode, arming, attitude, battery")  # fmt: skip
VEHICLE_IMU = Topic("vehicle/imu", ImuSamples, "autopilot", ("fusion",), 40, 0.3, _A, _STREAM, "data_high", express=True,
                    description="the autopilot's inertial samples, some to a message; only while fusion is on")  # fmt: skip
VEHICLE_GPS = Topic("vehicle/gps", GpsFix, "autopilot", ("fusion",), 5, 3.0, _A, _STREAM, "data_high",
                    description="fixes of the autopilot's GPS receiver; only while fusion wants them")  # fmt: skip
COMMAND = Topic("cmd/*", Command, "station", ("navigator",), 0, None, _R, _QUERY, "real_time", express=True,
                description="start hold resume abort land choose next: the reply says accepted or why not")  # fmt: skip
COMMAND_NONCE = Topic("nonce", NonceRequest, "station", ("navigator",), 0, None, _R, _QUERY, "real_time", express=True,
                      recorded=False, description="ask the aircraft for a nonce to command with")  # fmt: skip
FLEET_CLAIM = Topic("fleet/claim", ClaimRequest, "navigator", ("station",), 0, None, _R, _QUERY, "real_time", express=True, recorded=False,
                    description="claim, renew, release a tree among several aircraft, tell that it is done: the reply grants a duration or says why not")  # fmt: skip
FLEET_HELD = Topic("fleet/held", HeldState, "navigator", ("station",), 1, 3.0, _R, _STREAM, "data_high",
                   description="what the aircraft believes to hold, and for how long; only where claims are switched on")  # fmt: skip
CLOCK = Topic("clock", ClockRequest, ANY, ("router",), 0, None, _R, _QUERY, "real_time", express=True, recorded=False,
              description="ask the router for the time: all machines' clocks are brought to its own")  # fmt: skip
PREVIEW_IMAGE = Topic("preview/image", PreviewImage, "preview", ("station",), 5, None, _R, _LATEST, "background",
                      recorded=False, description="small picture with the overlay, sent only while somebody looks")  # fmt: skip
HEALTH = Topic("health/*", Health, ANY, ("navigator", "router", "station"), 1, 3.0, _R, _STREAM, "data_high",
               description="each service's own account of itself")  # fmt: skip
SIM_RGBD = Topic("sim/rgbd", RgbdFrame, "simulator", ("camera",), 15, None, _H, _LATEST, recorded=False,
                 description="the simulated sensor's frames, for the camera service")  # fmt: skip
SIM_SECOND = Topic("sim/second", RgbdFrame, "simulator", ("second_camera",), 15, None, _H, _LATEST, recorded=False,
                   description="the second simulated sensor's frames")  # fmt: skip
SIM_CLOCK = Topic("sim/clock", SimClock, "simulator", (ANY,), 100, None, _H, _STREAM, "real_time", express=True,
                  description="simulated time")  # fmt: skip
SIM_TRUTH = Topic("sim/truth", SimTruth, "simulator", ("evaluate",), 15, None, _H, _STREAM,
                  description="true pose and trees: benchmarks and summaries only")  # fmt: skip

TOPICS: tuple[Topic, ...] = (
    CAMERA_RGBD, SECOND_RGBD, CAMERA_COMPRESSED, SLAM_POSE, SECOND_POSE, FUSION_POSE, FUSION_STATE, SLAM_KEYFRAME, SLAM_GRAPH, MAP_CLOUD,
    MAP_SKETCH, MAP_INDEX, MAP_GROUND, TREES_LIST, TREES_TARGET, MISSION_STATE, MISSION_GUIDANCE, VEHICLE_STATE, VEHICLE_IMU, VEHICLE_GPS,
    COMMAND, COMMAND_NONCE, FLEET_CLAIM, FLEET_HELD, CLOCK, PREVIEW_IMAGE, HEALTH, SIM_RGBD, SIM_SECOND, SIM_CLOCK, SIM_TRUTH,
)  # fmt: skip

LIVE = "live/*"
"""Liveliness tokens, one per service: no payload, so no row of the table."""


def find(name: str) -> Topic:
    """Return the row for a key below the aircraft's prefix.

    Raises:
        KeyError: with the list of names when there is none.
    """
    for topic in TOPICS:
        if name == topic.name or (
            topic.name.endswith("/*") and name.startswith(topic.name[:-1]) and name.count("/") == topic.name.count("/")
        ):
            return topic
    raise KeyError(f"no topic {name!r}; the topics are {', '.join(t.name for t in TOPICS)}")
