"""One example of every message, used by the golden-bytes, fuzzing and bus tests."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from schemas.camera import Intrinsics, RgbdFrame
from schemas.codec import Wire
from schemas.command import Command, CommandReply, NonceReply, NonceRequest
from schemas.fleet import ClaimGoal, ClaimReply, ClaimRequest, HeldState
from schemas.fusion import EarthPlace, FusionState
from schemas.health import Health
from schemas.mapping import GroundCell, GroundPatch, MapIndex, Submap, SubmapsWanted
from schemas.navigation import Guidance, MissionState, Setpoint
from schemas.preview import PreviewImage
from schemas.simulation import SimClock, SimTruth, TrueTree
from schemas.sketch import SubmapSketch
from schemas.slam import Graph, GraphNode, Keyframe, Pose, Transform
from schemas.timekeeping import ClockReply, ClockRequest
from schemas.trees import Target, Tree, TreeList
from schemas.vehicle import GpsFix, ImuSample, ImuSamples, VehicleState

INTRINSICS = Intrinsics(width=4, height=2, fx=500.0, fy=501.0, cx=1.5, cy=0.5, k1=0.1, depth_scale=1000.0)
POSE = Transform(position_m=(1.0, -2.0, 0.5), quaternion_xyzw=(0.5, -0.5, 0.5, -0.5))
COVARIANCE = tuple(float(i) / 1000.0 for i in range(21))
TREE = Tree(
    id=7, x_m=2.5, y_m=-1.0, z_m=-0.1, axis=(0.0, 0.0, 1.0), radius_m=0.12, radius_height_m=1.3, height_seen_m=1.9,
    sigma_xy_m=0.01, sigma_radius_m=0.004, arc_rad=2.1, confidence=0.9, observations=12, suitable=True,
)  # fmt: skip
GOAL = ClaimGoal(
    kind="tree", map_id="map-1", from_m=(0.0, 0.5), to_m=(2.5, -1.0), radius_m=0.12, sigma_m=0.01, tree_id=7
)
TARGET = Target(
    stamp_ns=66_000_000, seq=1, map_id="map-1", status="tracking", tree_id=7, measured=True, bearing_rad=0.05,
    range_m=1.2, radius_m=0.12, image_x_px=310.0, sigma_bearing_rad=0.002, sigma_range_m=0.01, sigma_radius_m=0.004,
    raw_image_x_px=311.0, raw_range_m=1.21, raw_radius_m=0.121, position_map_m=(2.5, -1.0),
    covariance_map_m2=(1e-4, 0.0, 1e-4), note="",
)  # fmt: skip


def frame(width: int = 4, height: int = 2, seq: int = 3) -> RgbdFrame:
    """Return a small frame whose bytes tell where they came from."""
    intrinsics = INTRINSICS.model_copy(update={"width": width, "height": height})
    colour = bytes(i % 251 for i in range(3 * width * height))
    depth = bytes((i * 7) % 253 for i in range(2 * width * height))
    return RgbdFrame(66_000_000, seq, intrinsics, colour, depth, accel_camera=(0.1, -9.8, 0.2))


def submap() -> Submap:
    """Return a small submap."""
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    points = np.arange(6, dtype=np.float32).reshape(2, 3)
    view = np.array([0, 0], dtype=np.uint16)
    origins = np.zeros((1, 3), dtype=np.float32)
    colour = np.array([[1, 2, 3], [4, 5, 6]], dtype=np.uint8)
    return Submap("map-1", 5, 2, 9, 66_000_000, T, points, view, origins, colour)


def without_points(
    whole: Submap, by_m: tuple[float, float, float] = (0.0, 0.0, 0.0), later_s: float = 0.0, *, removed: bool = False
) -> Submap:
    """Return the message that moves a submap, or withdraws it."""
    T = whole.T_map_submap.copy()
    T[:3, 3] += by_m
    return replace(
        whole, T_map_submap=T, points_m=whole.points_m[:0], view=whole.view[:0], colour=whole.colour[:0], removed=removed,
        stamp_ns=whole.stamp_ns + round(1e9 * later_s),
    )  # fmt: skip


def sketch() -> SubmapSketch:
    """Return a small sketch of a submap."""
    points = np.arange(-3, 3, dtype=np.int16).reshape(2, 3)
    return SubmapSketch("map-1", 5, 2, 66_000_000, submap().T_map_submap, points, submap().colour)


def all_messages() -> dict[str, Wire]:
    """Return an example of every message by its schema's name."""
    setpoint = Setpoint(position_m=(0.0, 0.0, 1.5), yaw_rad=0.3, velocity_m_s=(0.1, 0.0, 0.0), yaw_rate_rad_s=0.4)
    true_tree = TrueTree(x_m=2.5, y_m=-1.0, z_m=-0.1, axis=(0.0, 0.0, 1.0), radius_m=0.12, suitable=True, fair=True)
    examples: list[Wire] = [
        frame(),
        submap(),
        sketch(),
        MapIndex(stamp_ns=66_000_000, map_id="map-1", epoch=1, graph_version=9, submap_ids=(5,), versions=(2,), placed_by=(9,),
                 ground_sequence=4),
        SubmapsWanted(map_id="map-1", submap_ids=(5, 7)),
        GroundPatch(stamp_ns=66_000_000, map_id="map-1", graph_version=9, sequence=4, cell_m=0.5, gone=((3, -2),), cells=(
            GroundCell(column=-1, row=2, height_m=-1.5, slope_x=0.1, slope_y=-0.02, relief_m=0.015, points=212),)),
        Pose(stamp_ns=66_000_000, seq=1, map_id="map-1", status="tracking", T_map_camera=POSE, covariance=COVARIANCE,
             reset_counter=1, graph_version=4, keyframe_id=3, T_keyframe_camera=POSE, inliers=321, up_sigma_rad=0.004,
             processing_ms=18.5),
        Keyframe(keyframe_id=3, stamp_ns=66_000_000, map_id="map-1", graph_version=4, T_map_camera=POSE,
                 intrinsics=INTRINSICS, depth_encoding="png", depth=b"\x89PNG", colour_jpeg=b"\xff\xd8"),
        Graph(stamp_ns=66_000_000, map_id="map-1", version=5, reset_counter=1, reason="loop",
              nodes=(GraphNode(keyframe_id=3, T_map_camera=POSE),), up_sigma_rad=0.004),
        TreeList(stamp_ns=66_000_000, map_id="map-1", version=2, graph_version=5, trees=(TREE,)),
        TARGET,
        Guidance(stamp_ns=66_000_000, seq=1, map_id="map-1", command="toward", magnitude=0.4, unit="m", engage=True,
                 land=False, mission_id=1, reset_counter=1, setpoint=setpoint, reason="approach"),
        MissionState(stamp_ns=66_000_000, seq=1, map_id="map-1", state="approach", previous="face", since_ns=1,
                     reason="tree 7 is in the middle of the image", target_tree_id=7, visited_tree_ids=(3,),
                     docked_count=1, distance_m=1.4, heading_error_rad=-0.01),
        VehicleState(stamp_ns=66_000_000, seq=1, connected=True, armed=True, mode="offboard", landed="in_air",
                     quaternion_map_body=(0.0, 0.0, 0.0, 1.0), position_map_m=(0.0, 0.0, 1.5),
                     velocity_map_m_s=(0.0, 0.0, 0.0), battery_share=0.8, vision_fused=True, operator_override=False,
                     engaged_mission_id=1, link_age_s=0.02),
        ImuSamples(stamp_ns=66_000_000, seq=3, samples=(
            ImuSample(stamp_ns=58_000_000, gyro_rad_s=(0.01, -0.02, 0.3), accel_m_s2=(0.1, -0.2, 9.8)),
            ImuSample(stamp_ns=66_000_000, gyro_rad_s=(0.02, -0.01, 0.3), accel_m_s2=(0.2, -0.1, 9.7)))),
        GpsFix(stamp_ns=66_000_000, seq=2, fix="3d", satellites=14, latitude_deg=47.4, longitude_deg=8.5, altitude_m=488.0,
               horizontal_sigma_m=1.3, vertical_sigma_m=2.4),
        FusionState(stamp_ns=66_000_000, seq=2, map_id="map-1", carrier="imu", carried_s=0.4, gps="distrusted",
                    gps_word="its fixes are not where the aircraft can be", place=EarthPlace(
                        latitude_deg=47.4, longitude_deg=8.5, altitude_m=488.0, heading_rad=0.3, sigma_m=1.2),
                    accel_bias_m_s2=(0.05, -0.02, 0.01), gyro_bias_rad_s=(0.001, 0.0, -0.002), restarts=1,
                    jumps_announced=0),
        Health(service="slam", stamp_ns=66_000_000, seq=1, state="ready", pid=12, uptime_s=3.5,
               counters={"frames": 40}, rates_hz={"camera/rgbd": 15.0}, work_ms={"track": 18.0},
               version="0.1.0+0a1b2c3d"),
        NonceRequest(sender="station"),
        NonceReply(nonce=bytes(range(16)), valid_s=30.0, next_sequence=1),
        Command(name="choose", sender="station", nonce=bytes(range(16)), sequence=1, tree_id=7),
        CommandReply(accepted=False, reason="no tree 7 in the list", state="idle"),
        ClaimRequest(kind="claim", lease_id=12, goal=GOAL, again=True),
        ClaimReply(arbiter="arbiter-1", lease_id=12, granted=False, lease_s=0.0, reason="uav2 holds this tree", final=False),
        HeldState(stamp_ns=66_000_000, seq=1, map_id="map-1", held=GOAL, left_s=21.5, asked=None, undelivered=1,
                  note="uav2 holds this tree"),
        ClockRequest(sender="slam"),
        ClockReply(stamp_ns=66_000_000),
        SimClock(stamp_ns=66_000_000, seq=1, phase="running", frames=2),
        SimTruth(stamp_ns=66_000_000, seq=1, scene="single-01", T_map_camera=POSE, trees=(true_tree,), touched=0,
                 clearance_m=1.2),
        PreviewImage(b"\xff\xd8\xff\xe0 picture \xff\xd9"),
    ]  # fmt: skip
    return {example.SCHEMA: example for example in examples}  # type: ignore[attr-defined]
