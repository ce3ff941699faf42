"""A place found blind: near and very far points together lead no pose astray, and one that nothing near tells is none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.common.geometry import exp_rotation
from services.slam.features import Features
from services.slam.motion import Motion
from services.slam.relocation import Relocation, position_sigma_m
from services.slam.slam import Slam
from services.slam.tracking import Tracked
from tests.unit.slam_room import INTRINSICS, look, turn_on_the_spot
from tests.unit.test_slam_runaway import CONFIG

F64 = NDArray[np.float64]

PERIOD_NS = 66_666_667


def seen(slam: Slam, world: F64, R: F64, t: F64, noise_px: float, rng: np.random.Generator) -> Features:
    """Return features that see points (N, 3) from a pose, those within 8 m with depth."""
    c = slam.camera.array
    X = world @ R.T + t
    uv = np.stack([c[0] * X[:, 0] / X[:, 2] + c[2], c[1] * X[:, 1] / X[:, 2] + c[3]], axis=1)
    uv += rng.normal(0.0, noise_px, uv.shape)
    n, near = len(world), X[:, 2] < 8.0
    depth = np.where(near, X[:, 2], 0.0)
    zeros = np.zeros(n)
    return Features(
        uv, np.zeros(n, np.int32), zeros, rng.integers(0, 2**63, (n, 4)).astype(np.uint64), depth,
        np.where(near, c[4] / X[:, 2], 0.0), ~near, np.where(near, 25.0, 0.0), np.zeros(0, np.int32), np.zeros(0, np.int32),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(12))
def test_points_kilometres_away_do_not_lead_a_blind_pose_astray(seed: int) -> None:
    rng = np.random.default_rng(seed)
    slam = Slam(INTRINSICS, CONFIG)
    for k, T in enumerate(turn_on_the_spot(2, 1.0)):
        slam.track(k * PERIOD_NS, *look(T))
    direction = np.stack([rng.uniform(-0.5, 0.5, 200), rng.uniform(-0.4, 0.4, 200), np.ones(200)], axis=1)
    z = np.concatenate([rng.uniform(1.5, 7.0, 90), np.exp(rng.uniform(np.log(10.0), np.log(10_000.0), 110))])
    R = exp_rotation(rng.normal(0.0, 0.1, 3))
    t = rng.normal(0.0, 0.5, 3)
    world = (direction * z[:, None] - t) @ R
    features = seen(slam, world, R, t, 0.7, rng)
    points = slam.atlas.points
    known = slam.atlas.reserve_points(200)
    points.pos[known] = world
    points.parallax[known] = np.where(z < 8.0, -1.0, 0.005)
    points.frame[known, 0] = slam.atlas.slots[0]
    found = slam.tracking.locate_by_ransac(features, world, np.arange(200, dtype=np.int32), known.astype(np.int32))
    assert found is not None
    assert np.linalg.norm(found.R.T @ found.t - R.T @ t) < 0.05
    assert found.inliers > 80


def test_a_place_known_to_kilometres_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(INTRINSICS, CONFIG)
    poses = turn_on_the_spot(6, 25.0)
    for k, T in enumerate(poses):
        slam.track(k * PERIOD_NS, *look(T))
    grey, depth_m = look(poses[-1])
    features = slam._extractor.extract(grey, depth_m)
    relocation = Relocation(slam.loops, slam._verifier)
    good = relocation.find(10**12, features, depth_m)
    assert good is not None
    assert position_sigma_m(good) < 0.02
    assert good.information is not None
    vague = Tracked(
        good.features,
        good.R,
        good.t + 400_000.0,
        good.point,
        good.inliers,
        good.information * 1e-12,
        0.0,
        None,
        good.expected,
    )
    monkeypatch.setattr(slam.loops, "relocate", lambda _: iter([vague]))
    assert position_sigma_m(vague) > 1000.0
    assert relocation.find(10**12 + 1, features, depth_m) is None
    assert relocation.find(10**12 + 2, features, depth_m) is None, "nor when a second frame says the same"


def test_two_frames_at_one_moment_tell_no_velocity() -> None:
    motion = Motion()
    step = np.eye(4)
    step[0, 3] = 0.02
    for k in range(4):
        motion.update(k * PERIOD_NS, None if k == 0 else step)
    before = motion.velocity(4 * PERIOD_NS)
    assert before.v_m_s[0] == pytest.approx(0.3, rel=0.01)
    tiny = np.eye(4)
    tiny[1, 3] = 0.01
    for stamp in (3 * PERIOD_NS + 1, 3 * PERIOD_NS + 2_000_000):  # a stamp of its arrival, after a stall
        assert motion.velocity(stamp, tiny).v_m_s[1] == pytest.approx(before.v_m_s[1])
        motion.update(stamp, tiny)
    after = motion.velocity(4 * PERIOD_NS)
    np.testing.assert_allclose(after.v_m_s, before.v_m_s)
    assert motion.plausible(4 * PERIOD_NS, step)


@pytest.mark.parametrize("degrees", [60.0, 130.0])
def test_a_camera_whose_stamps_bunch_is_not_lost(degrees: float) -> None:
    slam = Slam(INTRINSICS, CONFIG)
    stamp, results = 0, []
    for k, T in enumerate(turn_on_the_spot(40, degrees)):
        stamp += 500_000 if k % 10 == 5 else PERIOD_NS
        results.append(slam.track(stamp, *look(T)))
    assert [r.status for r in results] == ["tracking"] * 40
    assert {r.reset_counter for r in results} == {0}, "nor does it have to find its place anew"
