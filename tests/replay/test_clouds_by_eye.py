"""Stems that were confirmed by eye (docs/clouds.md) are listed, and nothing else is. Skipped where the recordings are absent."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from services.evaluate.bench_peers import PeerCloud, match
from services.evaluate.peer_clouds import real_clouds

DATA = Path(os.environ.get("TREEDOCK_DATA") or Path(__file__).parents[3] / "shared" / "data") / "clouds"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason=f"the recordings are not here: {DATA}")

SPANNER_M = (
    (53.2, 23.8), (39.4, 27.7), (38.2, 28.0), (29.4, 29.2), (44.7, 28.0), (42.4, 29.7), (36.2, 30.6), (43.8, 31.8),
    (48.3, 31.2), (43.6, 32.3), (32.2, 34.2), (35.8, 34.1), (47.3, 33.1), (48.5, 33.6), (29.6, 36.7), (38.3, 36.2),
    (51.8, 37.2), (46.6, 38.2), (45.2, 39.6), (34.7, 41.6), (41.9, 41.8), (48.4, 43.8), (53.0, 44.5), (38.1, 47.0),
    (41.8, 46.8), (51.8, 46.2), (42.4, 47.8),
)  # fmt: skip
"""From (470600, 3810200)."""


def counted(cloud: PeerCloud) -> tuple[int, int]:
    """Return how many of the stems are listed, and how many listed stand for nothing."""
    from services.detector.detect import detect_trees

    stems = []
    for t in detect_trees(cloud.points_m, (0.0, 0.0, 1.0)).trunks:
        x, y = np.array(t.base_m[:2]) + 1.3 * np.array(t.axis[:2]) / t.axis[2]
        stems.append((float(x), float(y), t.radius_m))
    pairs, false = match(stems, cloud)
    return len(pairs), false


@pytest.mark.parametrize(
    ("name", "least"), [("TreeLS_pine", 1), ("TreeLS_square", 26), ("TLS_to_FDS_test_trunks", 4), ("iLiDAR_trees_on_hill", 11)]
)  # fmt: skip
def test_stems_that_the_eye_sees_and_no_others(name: str, least: int) -> None:
    cloud = next(c for c in real_clouds(DATA, print) if c.name == name)
    found, false = counted(cloud)
    assert found >= least
    assert false == 0


def test_undergrowth_lists_stems_only() -> None:
    from services.detector.readers import read_cloud

    points = read_cloud(DATA / "spanner_MLS_Clip.laz").points_m
    stems = tuple((470600.0 + x, 3810200.0 + y, float("nan")) for x, y in SPANNER_M)
    found, false = counted(PeerCloud("spanner_MLS_Clip", points, stems))
    assert found >= 23
    assert false == 0
