"""Three machines with a router between, in network namespaces: the mission docks although the clocks differ by 200 ms."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.evaluate.faults.split import in_namespaces


@pytest.mark.slow
def test_a_mission_over_three_machines_docks(tmp_path: Path) -> None:
    """Camera, autopilot and simulator; slam and refiner; mapper, detector and navigator.

    Frames cross compressed and none raw; the clocks' offsets are measured, corrected and named by the doctor.
    """
    told: list[str] = []
    result = in_namespaces("split", 9001, 1, tmp_path, told.append)
    if result.skipped:
        pytest.skip(result.skipped)
    assert result.passed, "\n".join([*result.failed, *result.told, *told])
    assert result.measured["docked"] == 1.0
