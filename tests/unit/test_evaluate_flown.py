"""A flight's figures: the dockings and the chain's errors come out as they were put in; who joins a flying run."""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass, field

import numpy as np
import pytest

from schemas.navigation import MissionState, MissionStateName
from schemas.simulation import SimTruth, TrueTree
from schemas.slam import Pose
from schemas.trees import Target
from services.cli.mission import flies, prepared
from services.cli.run_plan import services_for
from services.cli.summary import mission_lines
from services.common.config import TreedockConfig
from services.common.errors import InputError
from services.common.geometry import level_camera, to_transform
from services.evaluate.flown import mission_figures, to_axis

TREE = TrueTree(x_m=3.0, y_m=1.0, z_m=-0.1, axis=(0.0, 0.0, 1.0), radius_m=0.1, suitable=True, fair=True)
STEP_NS = 66_000_000


@dataclass
class Record:
    states: list[MissionState] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    truths: list[SimTruth] = field(default_factory=list)


def state(name: MissionStateName, at_ns: int, docked: int = 0) -> MissionState:
    return MissionState(
        stamp_ns=at_ns, seq=0, map_id="m", state=name, previous="idle", since_ns=at_ns, reason=f"now {name}",
        target_tree_id=4, visited_tree_ids=(), docked_count=docked, distance_m=0.95, heading_error_rad=0.0,
    )  # fmt: skip


def flown(distance_m: float = 0.94, heading_deg: float = 1.0, shift_m: float = 0.02, suitable: bool = True) -> Record:
    """Return five seconds in front of the tree; pose and range believed ``shift_m`` off."""
    record = Record()
    tree = TREE.model_copy(update={"suitable": suitable})
    yaw = -math.radians(heading_deg)  # the tree is then to the left
    at = np.array([TREE.x_m - distance_m, TREE.y_m, 1.4])
    for i in range(76):
        stamp_ns = 1_000_000_000 + i * STEP_NS
        T, believed = level_camera(at, yaw), level_camera(at + np.array([0.0, shift_m, 0.0]), yaw)
        record.truths.append(SimTruth(
            stamp_ns=stamp_ns, seq=i, scene="s", T_map_camera=to_transform(T), trees=(tree,), touched=0, clearance_m=0.8
        ))  # fmt: skip
        values = {"stamp_ns": stamp_ns, "seq": i, "map_id": "m", "status": "tracking"}
        pose = {"T_map_camera": to_transform(believed), "reset_counter": 0, "graph_version": 0, "inliers": 9,
                "up_sigma_rad": 0.0, "processing_ms": 1.0}  # fmt: skip
        record.poses.append(Pose.model_validate(dict.fromkeys(Pose.model_fields) | values | pose))
        target = {"tree_id": 4, "measured": True, "range_m": distance_m + shift_m, "note": "",
                  "bearing_rad": math.radians(heading_deg)}  # fmt: skip
        record.targets.append(Target.model_validate(dict.fromkeys(Target.model_fields) | values | target))
    end_ns = record.truths[-1].stamp_ns
    record.states += [state("approach", 1_000_000_000), state("docked", end_ns, 1), state("landed", end_ns + 1, 1)]
    return record


def test_a_docking_is_told_believed_beside_true() -> None:
    values = mission_figures(flown())
    assert values["docked"]
    dock = values["docks"][0]
    assert dock["true_distance_m"] == pytest.approx(0.94, abs=1e-4)
    assert dock["distance_m"] == pytest.approx(0.96, abs=1e-4)
    assert dock["true_heading_deg"] == pytest.approx(1.0, abs=0.02)
    assert [event["state"] for event in values["events"]] == ["approach", "docked", "landed"]
    text = "\n".join(mission_lines({"mission": values}))
    assert "0.960 believed, 0.940 true m" in text
    assert "docked; mission landed" in text


@pytest.mark.parametrize(
    ("distance_m", "heading_deg", "suitable"), [(1.03, 0.0, True), (0.8, 0.0, True), (0.95, 3.4, True), (0.95, 0.0, False)]
)  # fmt: skip
def test_what_is_no_docking_in_truth_is_none(distance_m: float, heading_deg: float, suitable: bool) -> None:
    values = mission_figures(flown(distance_m, heading_deg, 0.0, suitable))
    assert not values["docked"]
    assert "NOT docked" in mission_lines({"mission": values})[-1]


def test_a_mission_that_never_docked_or_never_began() -> None:
    record = flown()
    record.states = record.states[:1]
    assert not mission_figures(record)["docked"]
    values = mission_figures(Record())
    assert (values["docked"], values["state"]) == (False, "idle")


def test_chain_errors_come_out_as_put_in() -> None:
    errors = mission_figures(flown(shift_m=0.03))["errors"]
    assert errors["pose_m_rmse"] == pytest.approx(0.03, abs=1e-4)
    assert errors["pose_m_white"] == pytest.approx(0.0, abs=1e-4)
    assert errors["range_m_mean"] == pytest.approx(0.03, abs=1e-4)
    assert errors["close_range_m_rmse"] == pytest.approx(0.03, abs=1e-4)
    assert errors["yaw_deg_max"] == pytest.approx(0.0, abs=1e-3)
    assert errors["poses_lost"] == 0


def test_the_axis_of_a_leaning_trunk_is_taken_at_the_cameras_height() -> None:
    leaning = TREE.model_copy(update={"z_m": 0.0, "axis": (math.sin(0.1), 0.0, math.cos(0.1))})
    distance_m, bearing_rad = to_axis(level_camera((0.0, 1.0, 1.5), 0.0), leaning)
    assert distance_m == pytest.approx(3.0 + 1.5 * math.tan(0.1), abs=1e-9)
    assert bearing_rad == pytest.approx(0.0, abs=1e-9)


def test_a_simulated_run_flies_and_its_two_ends_meet_on_a_port_of_their_own() -> None:
    tree = TreedockConfig.model_validate({"camera": {"source": "sim"}})
    one, two = prepared(tree, "builtin"), prepared(tree, "builtin")
    assert flies(one)
    assert one.clock == "sim"
    assert set(services_for(one)) >= {"navigator", "autopilot", "simulator"}
    port = one.simulator.px4.links[0].remote_port
    assert one.autopilot.connection == f"udpin:127.0.0.1:{port}"
    assert two.autopilot.connection != one.autopilot.connection
    scan = prepared(
        TreedockConfig.model_validate({"camera": {"source": "sim"}, "simulator": {"mode": "scan"}}), "builtin"
    )
    assert not flies(scan)
    assert "navigator" not in services_for(scan)


def test_another_autopilot_gets_the_simulator_between_it_and_the_bridge() -> None:
    tree = TreedockConfig.model_validate({"camera": {"source": "sim"}})
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(InputError, match="what else listens there"):
            prepared(tree, address)
    made = prepared(tree, address)
    assert made.simulator.mode == "external"
    assert made.clock == "wall"
    assert made.simulator.external.endpoint == address
    assert made.simulator.external.bridge == made.autopilot.connection.replace("udpin", "udpout")
    for wrong in ("serial:x:1", "udpin:5", "udpin:127.0.0.1:0", "px4"):
        with pytest.raises(InputError, match="expected builtin"):
            prepared(tree, wrong)
