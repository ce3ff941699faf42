"""The fusion's benchmark: the flown motion, the model of slam's errors, what is judged and how it is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from services.evaluate.bench_fusion import _tables
from services.evaluate.fusion_flight import FRAME_HZ, FlownWay, fly
from services.evaluate.fusion_model import located_by_model
from services.evaluate.fusion_rendered import FIRST
from services.evaluate.fusion_scenarios import SCENARIOS, Flight, make, measure, oval
from services.simulator.px4.config import GpsConfig, WindConfig

SECONDS = 8.0


@pytest.fixture(scope="module")
def flown() -> FlownWay:
    return fly(oval, SECONDS, 5, WindConfig(), GpsConfig(present=True))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    scenario = replace(SCENARIOS[2], seconds=SECONDS, dark_s=((6.0, 7.0),))
    return make(scenario, 5, tmp_path_factory.mktemp("fusion"), lambda _: None)


def test_the_flight_follows_its_way_and_the_imu_feels_it(flown: FlownWay) -> None:
    assert len(flown.frames) == pytest.approx(SECONDS * FRAME_HZ, abs=1)
    for frame in flown.frames[30:]:
        wanted, _ = oval((frame.stamp_ns - flown.frames[0].stamp_ns) * 1e-9)
        assert np.linalg.norm(frame.T_world_body[:3, 3] - wanted) < 0.5
    force = np.mean([r.accel_m_s2 for r in flown.imu], axis=0)
    assert force[2] == pytest.approx(9.8, abs=0.3)
    turned = sum(r.gyro_rad_s[2] for r in flown.imu if r.stamp_ns > flown.frames[0].stamp_ns) * 0.008
    assert turned == pytest.approx(oval(SECONDS)[1], abs=0.15)
    stamps = [f.stamp_ns for f in flown.fixes]
    assert len(stamps) == pytest.approx(5 * SECONDS, abs=1)
    assert np.allclose(np.diff(stamps), 0.2e9, atol=5e6)


def test_the_same_arguments_give_the_same_flight(flown: FlownWay) -> None:
    again = fly(oval, 1.0, 5, WindConfig(), GpsConfig(present=True))
    assert np.array_equal(again.frames[-2].T_world_body, flown.frames[len(again.frames) - 2].T_world_body)


def test_the_model_loses_what_it_is_told_to_and_comes_back_with_a_reset(flown: FlownWay) -> None:
    told = located_by_model(flown.frames, FIRST, lambda k: 30 <= k < 45, 3)
    lost = [k for k, place in enumerate(told) if place is None]
    assert lost == list(range(30, 48)), "found again three frames late"
    before, after = told[29], told[48]
    assert before is not None
    assert after is not None
    assert (before.epoch[1], after.epoch[1]) == (0, 1)
    apart = after.T_map_camera[:3, 3] - (flown.frames[48].T_world_body @ FIRST)[:3, 3]
    assert np.linalg.norm(apart) < 0.3


def test_what_imu_and_second_camera_buy_is_seen_in_a_flight(flight: Flight) -> None:
    rows = {setup: measure(flight, setup, 1.0) for setup in ("vision only", "+ IMU", "+ second camera")}
    assert rows["vision only"]["without_s"] == pytest.approx(1.2, abs=0.1)
    assert rows["vision only"]["carried_s"] == 0.0
    assert rows["+ IMU"]["without_s"] < 0.5
    assert rows["+ second camera"]["without_s"] < 0.2
    assert rows["+ second camera"]["carried_worst_m"] < 0.15
    assert all(row["restarts"] == 0 for row in rows.values())


def test_the_table_has_a_line_for_every_set_up() -> None:
    row = {"rmse_m": 0.1, "worst_m": 0.2, "yaw_deg": 1.0, "without_s": 2.0, "carried_s": 1.0, "carried_worst_m": 0.05,
           "nees": 2.0, "ms": 1.5, "earth_rmse_m": 1.2, "earth_worst_m": 2.0, "earth_end_m": 1.0, "caught_s": [50.0]}  # fmt: skip
    jump, honest = SCENARIOS[4], SCENARIOS[6]
    text = "\n".join(_tables({(s.name, setup): [row] for s in (jump, honest) for setup in s.setups}, (jump, honest)))
    assert "| GPS jump | + IMU + GPS | 1.20 | 2.00 | 1.00 | 5 |" in text
    assert "| GPS honest | + GPS | 1.20 | 2.00 | 1.00 | wrongly in 1 of 1 flights |" in text
    assert text.count("| GPS jump | vision only |") == 2
